"""A user's scan: read, brought to metres and +Y up, repaired, and known to be a person's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from smplxpp.clean import check_human_scale, convert_points, sanitize
from smplxpp.clean.repair import Sanitized
from smplxpp.core.errors import InputError
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.core.mesh_files.raw_mesh import RawMesh


@dataclass(frozen=True, eq=False)
class ScanFile:
    """A scan as its file has it, and repaired.

    Attributes:
        raw: in the file's units and axes.
        clean: metres, +Y up, with the places of its elements in the file.
    """

    raw: RawMesh
    clean: Sanitized


def read_scan(path: Path, *, units: str = "m", up: str = "y") -> ScanFile:
    """Read a scan.

    Raises:
        InputError: a file without a surface, or no person that stands upright in metres; the file is named.
    """
    raw = read_raw_mesh(path)
    vertices = convert_points(raw.vertices, units=units, up=up)
    try:
        clean = sanitize(vertices, raw.faces)
    except InputError as error:
        raise InputError(
            f"scan {path.name}: {error.subject}",
            expected=error.expected,
            received=error.received,
            remedy=error.remedy,
        ) from None
    check_human_scale(clean.mesh.vertices, subject=f"scan {path.name}")
    return ScanFile(raw, clean)
