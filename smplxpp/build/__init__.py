"""Build a template in memory: from a scan, with what is known of it, to body and clothes as one skinned mesh.

This is the top room of the package. It puts the stages (`capture` to `metrics`) in order; nothing below imports it. The
names are loaded when they are first used.
"""

from __future__ import annotations

from importlib import import_module

_EXPORTS: dict[str, str] = {
    "BuildConfig": "smplxpp.build.config",
    "BuildInputs": "smplxpp.build.config",
    "BuildReport": "smplxpp.build.report",
    "BuildResult": "smplxpp.build.report",
    "MeshVerdict": "smplxpp.build.mesh_verdict",
    "Part": "smplxpp.build.data",
    "ScanFile": "smplxpp.build.scan",
    "build_template": "smplxpp.build.template",
    "check_mesh": "smplxpp.build.mesh_verdict",
    "read_scan": "smplxpp.build.scan",
}

__all__ = [*_EXPORTS]


def __getattr__(name: str) -> object:
    if name in _EXPORTS:
        return getattr(import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module 'smplxpp.build' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
