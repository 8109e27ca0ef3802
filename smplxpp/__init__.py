"""SMPLX++: personalised clothed body templates from scans, measured at every step.

`build_template` makes a template of a scan or a capture; the other names are its parts. They are loaded when they are
first used, so that importing the package, or its metrics alone, is quick.

Example:
    >>> result = smplxpp.build_template("scan.ply")  # doctest: +SKIP
    >>> print(result.report)  # doctest: +SKIP
    >>> result.template.export("anna.glb")  # doctest: +SKIP
"""

from __future__ import annotations

from importlib import import_module, metadata

from smplxpp.native import let_workers_sleep

let_workers_sleep()
_EXPORTS: dict[str, str] = {
    "BodyModel": "smplxpp.body",
    "BodyNotFoundError": "smplxpp.register.locate",
    "BodyParams": "smplxpp.core",
    "BuildConfig": "smplxpp.build",
    "BuildReport": "smplxpp.build",
    "BuildResult": "smplxpp.build",
    "Camera": "smplxpp.core",
    "Capture": "smplxpp.capture",
    "GeometryWarning": "smplxpp.core",
    "InputError": "smplxpp.core",
    "LabelSet": "smplxpp.segment",
    "SkinWeights": "smplxpp.core",
    "Template": "smplxpp.template",
    "TransferConfig": "smplxpp.transfer",
    "TriangleMesh": "smplxpp.core",
    "as_mesh": "smplxpp.core",
    "build_template": "smplxpp.build",
    "check_mesh": "smplxpp.build",
    "load_body": "smplxpp.body",
    "load_params": "smplxpp.body",
    "open_capture": "smplxpp.capture",
    "pose": "smplxpp.skinning",
    "read_mesh": "smplxpp.core",
    "read_scan": "smplxpp.build",
    "transfer_weights": "smplxpp.transfer",
    "unpose": "smplxpp.skinning",
    "write_glb": "smplxpp.export",
}
_MODULES = ("metrics",)
_OF_A_CHECKOUT = "0+checkout"  # version of a source tree that is not installed

__all__ = [*_EXPORTS, *_MODULES]


def __getattr__(name: str) -> object:
    if name == "__version__":
        try:
            return metadata.version("smplxpp")
        except metadata.PackageNotFoundError:
            return _OF_A_CHECKOUT
    if name in _EXPORTS:
        return getattr(import_module(_EXPORTS[name]), name)
    if name in _MODULES:
        return import_module(f"smplxpp.{name}")
    raise AttributeError(f"module 'smplxpp' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "__version__"])
