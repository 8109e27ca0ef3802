"""USD's modules, and a stage that becomes a file whole or not at all."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import WRITE_ERRORS, atomic_path, atomic_write_bytes
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.lazy import import_extra

SUFFIXES = (".usdc", ".usda", ".usd", ".usdz")
_MODULES = ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdShade", "UsdSkel", "UsdUtils", "UsdVol", "Vt")


def usd_modules(purpose: str) -> SimpleNamespace:
    """Return the modules of `pxr` that are used here, by name.

    Raises:
        MissingExtraError: no usd-core.
    """
    return SimpleNamespace(
        **{name: import_extra(f"pxr.{name}", extra="usd", purpose=purpose, named="usd-core") for name in _MODULES}
    )


@contextmanager
def open_usd(
    path: str | Path, *, default: str, fps: float | None = None, beside: Mapping[str, bytes] | None = None
) -> Iterator[Any]:
    """A new stage in metres with +Y up, written when the block ends without an error.

    Args:
        path: .usdc (binary), .usda (text), .usd (binary) or .usdz (one package).
        default: name of the prim that stands for the file.
        fps: time codes a second; None: nothing moves.
        beside: files that the stage names, such as pictures; they are written beside it, or into the package.

    Raises:
        InputError: another suffix.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"output {path}", expected=f"one of {', '.join(SUFFIXES)}", received=path.suffix or "none")
    pxr = usd_modules("writing USD")
    packed = path.suffix.lower() == ".usdz"
    stage = pxr.Usd.Stage.CreateInMemory(f"stage{'.usdc' if packed else path.suffix.lower()}")
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().comment = f"smplxpp {metadata.version('smplxpp')}"
    if fps is not None:
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0)
    yield stage
    stage.SetDefaultPrim(stage.GetPrimAtPath(f"/{default}"))
    if packed:
        _write_package(pxr, stage, path, beside or {})
        return
    # Pictures first, so that no stage names files that are not there.
    for name, data in (beside or {}).items():
        atomic_write_bytes(path.parent / name, data)
    with atomic_path(path) as temporary:
        _export(pxr, stage, temporary)


def _write_package(pxr: SimpleNamespace, stage: Any, path: Path, beside: Mapping[str, bytes]) -> None:
    """Write a stage and its files as one package, uncompressed as the format demands."""
    with tempfile.TemporaryDirectory(prefix="smplxpp_usdz_") as folder, atomic_path(path) as temporary:
        inner = Path(folder) / f"{path.stem}.usdc"
        for name, data in beside.items():
            (Path(folder) / name).write_bytes(data)
        _export(pxr, stage, inner)
        # The package must be new, and be named as one.
        made = Path(folder) / "package.usdz"
        pxr.UsdUtils.CreateNewUsdzPackage(pxr.Sdf.AssetPath(str(inner)), str(made))
        temporary.write_bytes(read_bytes(made, subject="package"))


def _export(pxr: SimpleNamespace, stage: Any, path: Path) -> None:
    """Write a stage to a file; a full disk is an `OSError`, as it is with other files."""
    try:
        words = "" if stage.GetRootLayer().Export(str(path)) else os.strerror(errno.EIO)
    except pxr.Tf.ErrorException as error:  # thirty lines, in which the system's words are
        words = str(error)
    if words:
        code = next((one for one in WRITE_ERRORS if os.strerror(one) in words), errno.EIO)
        raise OSError(code, os.strerror(code))
