"""Read a scan, convert it to metres and +Y up, repair it, and check that it is a person's.

A point cloud becomes a surface here. Its vertices stand for points of the file (`Sanitized.source_vertex`), so that
labels and colours of points follow as those of a mesh's vertices do. It has no faces that labels could belong to.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8

from smplxpp.clean import PointSurface, Sanitized, sanitize, surface_from_points
from smplxpp.clean.scan_frame import AUTO, check_human_scale, convert_points, find_scan_frame
from smplxpp.core import GeometryWarning, InputError, MeshLike, TriangleMesh, as_mesh
from smplxpp.core.errors import one_line
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.core.mesh_files.raw_mesh import FacePictures, RawMesh, color_bytes
from smplxpp.core.mesh_files.texture import REPEAT, bounded_places, sample_texture
from smplxpp.segment import LabelSet, map_labels, read_labels
from smplxpp.segment.label_files import check_element_count

# Formats whose files are in metres: by the format, or because their reader converts the unit that they state.
_METRES = (".glb", ".gltf", ".fbx")


@dataclass(frozen=True, eq=False)
class ScanFile:
    """A scan as its file has it, and repaired.

    Attributes:
        raw: in the file's units and axes; without faces where it is a point cloud.
        clean: metres, +Y up, with the places of its elements in the file. Faces of a cloud's surface come from none
            (-1).
        units: in which the file is written, as given or as found; the length of one in millimetres where the person's
            height told it.
        up: upward axis of the file, as given or as found.
        note: how units and axis were found; empty where they were given.
    """

    raw: RawMesh
    clean: Sanitized
    units: str = "m"
    up: str = "y"
    note: str = ""

    __repr__ = one_line

    @cached_property
    def colors(self) -> UInt8[np.ndarray, "n 3"] | None:
        """sRGB of the repaired scan's vertices: the mean of the file's vertices that became one; None without any."""
        return None if self.raw.vertex_colors is None else self.clean.mean_colors(self.raw.vertex_colors)

    def scaled(self, factor: float) -> ScanFile:
        """Return the scan with its repaired surface scaled about the origin; 1 is the scan itself."""
        if factor == 1.0:
            return self
        mesh = self.clean.mesh
        clean = replace(self.clean, mesh=mesh.with_vertices(mesh.vertices * factor))
        note = f"{self.note}; scaled by {factor:.4f} so that the body in it has that stature"
        return replace(self, clean=clean, note=note)


def read_scan(scan: str | Path | MeshLike, *, units: str = "m", up: str = "y", height: float | None = None) -> ScanFile:
    """Read a scan: a mesh, or a point cloud, whose surface is reconstructed.

    Args:
        scan: a file (PLY, OBJ, GLB, STL, OFF, npz, pickle), or a mesh in memory with or without colours:
            `TriangleMesh`, `trimesh.Trimesh`, or a pair (vertices, faces).
        units: as `convert_points` takes them; "auto": metres of a glTF file, whose format states them, if that is a
            person's size, else found from the person's height.
        up: upward axis likewise; "auto": found from the shape of the person.
        height: metres from the lowest to the highest point, for a scan without a unit; it takes the place of `units`.
            A build corrects it for the pose, with the body that it finds (`smplxpp.build.locate_in_scan`).

    Raises:
        InputError: no surface, or no person that stands upright in metres; the file is named.
        MissingExtraError: a point cloud without the package that reconstructs its surface.

    Example:
        >>> scan = smplxpp.read_scan("data/fixtures/person/scans/scan_000000.ply")
        >>> scan.clean.mesh
        TriangleMesh(39,966 vertices, 80,000 faces)
    """
    if isinstance(scan, str | Path):
        path: Path | None = Path(scan)
        raw = read_raw_mesh(scan, clouds=True)
    else:
        path, raw = None, _raw_of(scan)
    name = "in memory" if path is None else path.name
    note, axes = "", True
    # A search for units and axis needs faces; a cloud gets a coarse surface for it, because the full one needs
    # metres.
    scale: str | float = units
    if AUTO in (units, up) or height is not None:
        vertices, faces = (raw.vertices, raw.faces) if not raw.is_cloud else _rough_surface(raw)
        stated = _stated_units(path, raw) if units == AUTO and height is None else units
        try:
            # glTF has +Y up by its specification; a person who kneels is as near to one who stands on the head.
            usual = "y" if path is not None and path.suffix.lower() in (".glb", ".gltf") else ""
            frame = find_scan_frame(vertices, faces, units=stated, up=up, height=height, usual=usual)
        except InputError as error:
            raise _named(error, name) from None
        axes = not (up == AUTO and frame.unambiguous)
        scale, up, note = frame.units, frame.up, frame.note
    # From here on metres and +Y up; faces keep their orientation, since the change of axes is a rotation.
    vertices = convert_points(raw.vertices, units=scale, up=up)
    try:
        clean = _of_cloud(path, raw, scale, up) if raw.is_cloud else sanitize(vertices, raw.faces)
    except InputError as error:
        raise _named(error, name) from None
    # The last guard of the units: a scan in centimetres, inches or millimetres that was read as metres fails here.
    check_human_scale(clean.mesh.vertices, subject=f"scan {name}", axes=axes)
    return ScanFile(raw, clean, scale if isinstance(scale, str) else f"{1000.0 * scale:.4g} mm", up, note)


def raw_scan(scan: str | Path | MeshLike) -> RawMesh | None:
    """Read a scan as its file has it, for its textures; None for formats that have none.

    Raises:
        InputError: as `read_scan`.
    """
    if not isinstance(scan, str | Path):
        return _raw_of(scan)
    if Path(scan).suffix.lower() not in (".obj", ".glb", ".gltf"):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # `read_scan` said what is wrong with the file
        return read_raw_mesh(scan)


def _named(error: InputError, name: str) -> InputError:
    """Return the error with the scan's name before its subject."""
    subject = error.subject if error.subject.startswith(f"scan {name}") else f"scan {name}: {error.subject}"
    return InputError(
        subject.replace(": scan:", ":"), expected=error.expected, received=error.received, remedy=error.remedy
    )


def _stated_units(path: Path | None, raw: RawMesh) -> str:
    """Return the units that a file's format states, if they give a person's size; else AUTO."""
    # glTF is in metres by its specification, but exporters of centimetres exist. Lower than what is asked about
    # elsewhere, because a stated unit makes a child or a crouching person plausible.
    if path is None or path.suffix.lower() not in _METRES:
        return AUTO
    finite = raw.vertices[np.isfinite(raw.vertices).all(axis=1)]
    size = float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0
    return "m" if 0.7 <= size <= 2.6 else AUTO


def scan_file_labels(
    labels: str | Path | np.ndarray, raw: RawMesh, *, label_set: str | LabelSet
) -> tuple[Int64[np.ndarray, " n"], bool]:
    """Read labels of a scan's vertices or faces, in the order of its file.

    Args:
        labels: a label file, the scan's own file, or an array of ids.
        raw: the scan as its file has it.
        label_set: the set that the ids are of.

    Returns:
        Labels in our ids, one a vertex or one a face, and whether they are of faces.

    Raises:
        InputError: no labels, another number of them than vertices or faces, or unknown ids.
    """
    vertex_count, face_count = len(raw.vertices), len(raw.faces)
    # An array has lost its file's layout, so that its length alone tells vertices from faces.
    if isinstance(labels, np.ndarray):
        check_element_count(labels, vertex_count=vertex_count, face_count=face_count, subject="labels of the scan")
        found = map_labels(labels, label_set)
    else:
        found = read_labels(
            labels,
            vertex_count=vertex_count,
            face_count=face_count,
            label_set=label_set,
            source_faces=raw.source_faces,
        )
    return found, len(found) == face_count


def _raw_of(mesh: MeshLike) -> RawMesh:
    """The arrays of a mesh in memory, with its colours where it has any (`visual.vertex_colors` of trimesh)."""
    found = as_mesh(mesh, subject="scan")
    visual = getattr(mesh, "visual", None)
    if getattr(visual, "kind", None) == "texture":
        return _textured(found, visual)
    # trimesh invents grey colours where a mesh has none, and says so by `kind`.
    colors = getattr(visual, "vertex_colors", None) if getattr(visual, "kind", None) == "vertex" else None
    kept = None if colors is None else color_bytes(np.asarray(colors), subject="scan")
    return RawMesh(found.vertices, found.faces, vertex_colors=kept)


def _textured(mesh: TriangleMesh, visual: Any) -> RawMesh:
    """The arrays of a `trimesh.Trimesh` with a picture; of one whose material has none, the shape alone."""
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    uv = np.asarray([] if visual.uv is None else visual.uv, dtype=np.float64)
    if image is None or uv.shape != (mesh.vertex_count, 2):
        return RawMesh(mesh.vertices, mesh.faces)
    picture = np.array(image.convert("RGB"))
    # trimesh counts v upwards.
    places = bounded_places(uv * [1, -1] + [0, 1])
    pictures = FacePictures(
        places[mesh.faces], np.zeros(mesh.face_count, np.int64), (lambda: picture,), ((REPEAT, REPEAT),)
    )
    colors = sample_texture(picture, places.astype(np.float64), top_down=True)
    return RawMesh(mesh.vertices, mesh.faces, vertex_colors=colors, pictures=pictures)


def _of_cloud(path: Path | None, raw: RawMesh, units: str | float, up: str) -> Sanitized:
    """The repaired surface of a cloud, its vertices traced to points."""
    if path is None:
        surface = _make_surface(raw, units, up)
    else:
        # Poisson reconstruction is slow. The file's time and size are the key of the cache; the points are not
        # compared.
        state = path.stat()
        surface = _surface(_Cloud(path, state.st_mtime_ns, state.st_size, units, up, raw))
    name = "scan in memory" if path is None else path.name
    warnings.warn(f"{name}: {surface.note}", GeometryWarning, stacklevel=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # defects of our own reconstruction are not the user's
        clean = sanitize(surface.mesh.vertices, surface.mesh.faces)
    # Vertices of the surface are traced to the nearest points of the cloud; its faces have no counterpart, hence -1.
    return Sanitized(
        clean.mesh,
        surface.source_point[clean.source_vertex],
        np.full(clean.mesh.face_count, -1, dtype=np.int64),
        clean.report,
        np.arange(len(raw.vertices)),
    )


def _rough_surface(raw: RawMesh) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a cloud of unknown units, in these units: made as if the person were of ordinary height."""
    ordinary_height = 1.7  # metres
    scale = ordinary_height / max(float(np.ptp(raw.vertices, axis=0).max()), 1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # repeated when the surface is made in metres
        mesh = surface_from_points(scale * raw.vertices, raw.vertex_normals).mesh
    return mesh.vertices / scale, mesh.faces


@dataclass(frozen=True)
class _Cloud:
    """The key of a cloud's surface; its points do not take part in the comparison."""

    path: Path
    changed: int
    size: int
    units: str | float
    up: str
    raw: RawMesh = field(compare=False)


@lru_cache(maxsize=2)
def _surface(cloud: _Cloud) -> PointSurface:
    """The surface of a cloud, kept because several steps of a build read one file and the reconstruction is slow."""
    return _make_surface(cloud.raw, cloud.units, cloud.up)


def _make_surface(raw: RawMesh, units: str | float, up: str) -> PointSurface:
    normals = raw.vertex_normals
    if normals is not None:
        normals = convert_points(normals, units="m", up=up)
    points = convert_points(raw.vertices, units=units, up=up)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # repeated at each reading
        return surface_from_points(points, normals)
