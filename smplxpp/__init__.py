"""SMPLX++: personalised clothed body templates from scans, measured at every step.

The names below are loaded when they are first used, so that importing the package, or its metrics alone, is quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from smplxpp.native import let_workers_sleep

let_workers_sleep()
_EXPORTS: dict[str, str] = {
    "BodyModel": "smplxpp.body",
    "BodyParams": "smplxpp.core.params",
    "InputError": "smplxpp.core.errors",
    "SkinWeights": "smplxpp.core.skin_weights",
    "Template": "smplxpp.template.template",
    "TransferConfig": "smplxpp.transfer",
    "TriangleMesh": "smplxpp.core.mesh",
    "load_body": "smplxpp.body",
    "load_params": "smplxpp.body",
    "pose": "smplxpp.skinning",
    "read_mesh": "smplxpp.core.mesh_io",
    "transfer_weights": "smplxpp.transfer",
    "unpose": "smplxpp.skinning",
    "write_glb": "smplxpp.export",
}
_MODULES = ("metrics",)

__all__ = [*_EXPORTS, *_MODULES]


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(import_module(_EXPORTS[name]), name)
    if name in _MODULES:
        return import_module(f"smplxpp.{name}")
    raise AttributeError(f"module 'smplxpp' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
