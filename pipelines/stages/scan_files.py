"""A user's scan: read, brought to metres and +Y up, repaired, and known to be a person's.

A cloud of points becomes a surface here. Its vertices stand for points of the file (`Sanitized.source_vertex`), so
that labels and colours of points go along as those of a mesh's vertices do; it has no faces that labels could be of.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from smplxpp.clean import (
    PointSurface,
    check_human_scale,
    convert_points,
    sanitize,
    surface_from_points,
)
from smplxpp.clean.repair import Sanitized
from smplxpp.clean.scan_frame import AUTO, find_scan_frame
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.core.mesh_files.raw_mesh import RawMesh

_ORDINARY_HEIGHT = 1.7


@dataclass(frozen=True, eq=False)
class ScanFile:
    """A scan as its file has it, and repaired.

    Attributes:
        raw: in the file's units and axes; without faces where it is a cloud of points.
        clean: metres, +Y up, with the places of its elements in the file; faces of a cloud's surface come from none
            (-1).
        units, up: in which the file is written, as given or as found. said: how they were found, in words.
    """

    raw: RawMesh
    clean: Sanitized
    units: str = "m"
    up: str = "y"
    said: str = ""

    @cached_property
    def colors(self) -> UInt8[np.ndarray, "n 3"] | None:
        """sRGB of the repaired scan's vertices: the mean of those of the file that became one; None without colours."""
        return None if self.raw.vertex_colors is None else self.clean.mean_colors(self.raw.vertex_colors)


def read_scan(path: Path, *, units: str = "m", up: str = "y") -> ScanFile:
    """Read a scan: a mesh, or a cloud of points, whose surface is reconstructed.

    Args:
        units, up: as `convert_points` takes them; "auto": found from the shape of the person.

    Raises:
        InputError: a file without a surface, or no person that stands upright in metres; the file is named.
        MissingExtraError: a cloud of points without the package that reconstructs its surface.
    """
    raw = read_raw_mesh(path, clouds=True)
    said = ""
    if AUTO in (units, up):
        vertices, faces = (raw.vertices, raw.faces) if not raw.is_cloud else _rough_surface(raw)
        frame = find_scan_frame(vertices, faces, units=units, up=up)
        units, up, said = frame.units, frame.up, frame.said
    vertices = convert_points(raw.vertices, units=units, up=up)
    try:
        clean = _of_cloud(path, raw, units, up) if raw.is_cloud else sanitize(vertices, raw.faces)
    except InputError as error:
        raise InputError(
            f"scan {path.name}: {error.subject}",
            expected=error.expected,
            received=error.received,
            remedy=error.remedy,
        ) from None
    check_human_scale(clean.mesh.vertices, subject=f"scan {path.name}")
    return ScanFile(raw, clean, units, up, said)


def _of_cloud(path: Path, raw: RawMesh, units: str, up: str) -> Sanitized:
    """The repaired surface of a cloud, its vertices traced to points."""
    state = path.stat()
    surface = _surface(_Cloud(path, state.st_mtime_ns, state.st_size, units, up, raw))
    warnings.warn(f"{path.name}: {surface.said}", GeometryWarning, stacklevel=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # what the reconstruction left is not the user's doing
        clean = sanitize(surface.mesh.vertices, surface.mesh.faces)
    return Sanitized(
        clean.mesh,
        surface.source_point[clean.source_vertex],
        np.full(clean.mesh.face_count, -1, dtype=np.int64),
        clean.report,
        np.arange(len(raw.vertices)),
    )


def _rough_surface(raw: RawMesh) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a cloud whose units are not known yet, in them: made as that of a person of ordinary height."""
    scale = _ORDINARY_HEIGHT / max(float(np.ptp(raw.vertices, axis=0).max()), 1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # said when the surface is made in metres
        mesh = surface_from_points(scale * raw.vertices, raw.vertex_normals).mesh
    return mesh.vertices / scale, mesh.faces


@dataclass(frozen=True)
class _Cloud:
    """What tells one cloud from another; its points are no part of the comparison."""

    path: Path
    changed: int
    size: int
    units: str
    up: str
    raw: RawMesh = field(compare=False)


@lru_cache(maxsize=2)
def _surface(cloud: _Cloud) -> PointSurface:
    """The surface of a cloud; several stages of a build read one file, and the reconstruction takes its time."""
    raw = cloud.raw
    normals = raw.vertex_normals
    if normals is not None:
        normals = convert_points(normals, units="m", up=cloud.up)
    points = convert_points(raw.vertices, units=cloud.units, up=cloud.up)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # said at each reading
        return surface_from_points(points, normals)
