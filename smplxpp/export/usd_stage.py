"""USD's modules, and a stage that becomes a file whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_path
from smplxpp.core.lazy import import_extra

SUFFIXES = (".usdc", ".usda", ".usd")
_MODULES = ("Gf", "Sdf", "Usd", "UsdGeom", "UsdShade", "UsdSkel", "UsdVol", "Vt")


def usd_modules(purpose: str) -> SimpleNamespace:
    """Return the modules of `pxr` that are used here, by name.

    Raises:
        MissingExtraError: no usd-core.
    """
    return SimpleNamespace(
        **{name: import_extra(f"pxr.{name}", extra="usd", purpose=purpose, named="usd-core") for name in _MODULES}
    )


@contextmanager
def open_usd(path: str | Path, *, default: str, fps: float | None = None) -> Iterator[Any]:
    """A new stage in metres with +Y up, written when the block ends without an error.

    Args:
        path: .usdc (binary), .usda (text) or .usd (binary).
        default: name of the prim that stands for the file.
        fps: time codes a second; None: nothing moves.

    Raises:
        InputError: another suffix.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"output {path}", expected=f"one of {', '.join(SUFFIXES)}", received=path.suffix or "none")
    pxr = usd_modules("writing USD")
    stage = pxr.Usd.Stage.CreateInMemory(f"stage{path.suffix.lower()}")
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().comment = f"smplxpp {metadata.version('smplxpp')}"
    if fps is not None:
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0)
    yield stage
    stage.SetDefaultPrim(stage.GetPrimAtPath(f"/{default}"))
    with atomic_path(path) as temporary:
        stage.GetRootLayer().Export(str(temporary))
