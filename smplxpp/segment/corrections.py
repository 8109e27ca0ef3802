"""Correct labels by hand: faces, brush strokes and boxes with a label, their file, and their application to a scan."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int64, Integer

from smplxpp.core import LABELS, Labels, TriangleMesh, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.errors import GeometryWarning, InputError, one_line
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import as_integer, as_list, as_number, as_numbers, as_object, as_text, read_json
from smplxpp.segment.corrected_faces import ScanSurface, nearest_faces, stroked_faces
from smplxpp.segment.segment import SegmentedScan

FORMAT_VERSION = 1
_KINDS = {"faces", "stroke", "box"}


@dataclass(frozen=True, eq=False)
class FaceCorrection:
    """A label for faces of a scan, by their indices.

    Attributes:
        label: label id.
        faces: indices of the faces in the scan.
        triangles: corners of the faces, metres, which locate them in another triangulation; None: only by index.
        scan: digest of the scan that the indices belong to; None: indices hold for any scan.
    """

    label: int
    faces: Int64[np.ndarray, " n"]
    triangles: Float64[np.ndarray, "n 3 3"] | None = None
    scan: str | None = None

    __repr__ = one_line

    @staticmethod
    def of(mesh: TriangleMesh, label: int, faces: Integer[np.ndarray, " n"]) -> FaceCorrection:
        """Build a correction of this mesh's faces with their corners and the mesh's digest."""
        faces = np.asarray(faces, dtype=np.int64)
        return FaceCorrection(label, faces, mesh.triangles[faces], scan_digest(mesh))


@dataclass(frozen=True, eq=False)
class StrokeCorrection:
    """A label for a brush stroke: the surface within a geodesic distance of a polyline.

    Attributes:
        label: label id.
        points: vertices of the polyline, metres, at most 25 cm apart.
        radius: of the brush, metres.
        normals: normals of the surface under the points, which tell its front from its back; None: those of the nearest
            faces.
    """

    label: int
    points: Float64[np.ndarray, "n 3"]
    radius: float
    normals: Float64[np.ndarray, "n 3"] | None = None

    __repr__ = one_line


@dataclass(frozen=True, eq=False)
class BoxCorrection:
    """A label for all faces whose centres lie in an oriented box.

    Attributes:
        label: label id.
        center: centre of the box, metres.
        size: lengths of its edges, metres.
        rotation: world from the box's own axes.
    """

    label: int
    center: Float64[np.ndarray, " 3"]
    size: Float64[np.ndarray, " 3"]
    rotation: Float64[np.ndarray, "3 3"]

    __repr__ = one_line


Correction = FaceCorrection | StrokeCorrection | BoxCorrection


def scan_digest(mesh: TriangleMesh) -> str:
    """Return the SHA-256 of a scan's vertices and faces, which tells whether indices of faces still hold."""
    whole = hashlib.sha256(np.ascontiguousarray(mesh.vertices, dtype=np.float64).tobytes())
    whole.update(np.ascontiguousarray(mesh.faces, dtype=np.int64).tobytes())
    return whole.hexdigest()


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections in the order in which they were made; a later one overrides an earlier one.

    They are applied to finished labels, after the graph cut, so that nothing smooths them away.

    Attributes:
        items: the corrections.
        labels: what their ids stand for; files hold the names.

    Example:
        >>> corrections = Corrections.load("runs/me/labels_corrections.json")
        >>> corrected = corrections.apply(mesh, segment_scan(mesh, votes=votes))
    """

    items: tuple[Correction, ...] = ()
    labels: Labels = LABELS

    def __len__(self) -> int:
        return len(self.items)

    @staticmethod
    def load(path: str | Path, *, labels: Labels = LABELS) -> Corrections:
        """Read and check the corrections in `labels_corrections.json` (docs/corrections.md).

        Raises:
            InputError: no such file, another version, unknown labels, numbers out of range; it names the entry.
        """
        most = 20_000  # far more than a session of painting; bounds the time that a damaged file costs
        subject = f"corrections {path}"
        content = as_object(read_json(path, subject="corrections"), subject=subject)
        version = as_integer(content.get("version", FORMAT_VERSION), subject=f"{subject}: version")
        if version != FORMAT_VERSION:
            raise InputError(f"{subject}: version", expected=f"{FORMAT_VERSION}", received=f"{version}")
        rows = as_list(content.get("corrections"), subject=f"{subject}: corrections")
        if len(rows) > most:
            raise InputError(subject, expected=f"at most {most} corrections", received=f"{len(rows)}")
        items = (_read(row, f"{subject}: correction {k + 1}", labels) for k, row in enumerate(rows))
        return Corrections(tuple(items), labels)

    def save(self, path: str | Path) -> None:
        """Write the file that `load` reads: one line for each correction, rounded to 0.1 mm, written atomically."""
        rows = ",\n  ".join(json.dumps(_written(item, self.labels), separators=(",", ":")) for item in self.items)
        inner = f"[\n  {rows}\n ]" if rows else "[]"
        atomic_write_text(path, f'{{\n "version": {FORMAT_VERSION},\n "corrections": {inner}\n}}\n')

    def face_labels(
        self, mesh: TriangleMesh, labels: Integer[np.ndarray, " M"], *, surface: ScanSurface | None = None
    ) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]]:
        """Return a scan's labels with all corrections applied, and the index of the correction that set each face.

        Args:
            mesh: the scan.
            labels: labels of its faces before the corrections.
            surface: search structures of the mesh, if they exist already.

        Returns:
            Labels of the faces, and for each face the index of its correction, -1 without one.

        Raises:
            InputError: indices of faces of another scan without the faces' corners.
        """
        surface, out = surface or ScanSurface(mesh), np.array(labels, dtype=np.int64)
        by = np.full(mesh.face_count, -1, dtype=np.int64)
        for k, item in enumerate(self.items):
            faces = faces_of(item, surface, subject=f"correction {k + 1} ({self.labels[item.label].name})")
            out[faces], by[faces] = item.label, k
        return out, by

    def apply(self, mesh: TriangleMesh, segmented: SegmentedScan) -> SegmentedScan:
        """Apply the corrections to labels; corrected faces have confidence 1, are seen, and are marked `corrected`."""
        labels, by = self.face_labels(mesh, segmented.face_labels)
        corrected = by >= 0
        return replace(
            segmented,
            face_labels=labels,
            confidence=np.where(corrected, 1.0, segmented.confidence),
            seen=segmented.seen | corrected,
            corrected=corrected,
        )


def faces_of(item: Correction, surface: ScanSurface, *, subject: str = "correction") -> Int64[np.ndarray, " n"]:
    """Return the faces of a scan that a correction covers.

    Warns:
        GeometryWarning: it covers none, or the scan has changed since and its faces were found by their corners.

    Raises:
        InputError: indices of faces of another scan without the faces' corners.
    """
    if isinstance(item, StrokeCorrection):
        faces = stroked_faces(surface, item.points, item.radius, normals=item.normals)
    elif isinstance(item, BoxCorrection):
        inside = np.abs((surface.centers - item.center) @ item.rotation) <= 0.5 * item.size
        faces = np.flatnonzero(inside.all(axis=1))
    else:
        faces = _indexed_faces(item, surface, subject)
    if not len(faces):
        warnings.warn(f"{subject}: nothing of the scan is there; it changes nothing", GeometryWarning, stacklevel=2)
    return faces


def _indexed_faces(item: FaceCorrection, surface: ScanSurface, subject: str) -> Int64[np.ndarray, " n"]:
    # Indices hold for the scan of the correction; on another one the faces are found by their corners.
    count = surface.mesh.face_count
    if item.scan is None or item.scan == surface.digest(scan_digest):
        if len(item.faces) and item.faces.max() >= count:
            raise InputError(
                subject,
                expected=f"faces 0 to {count - 1}, as the run's scan has them",
                received=f"{item.faces.max()}",
                remedy="name faces of RUN/08_capture/scan.npz, or use a box or a stroke",
            )
        return item.faces
    if item.triangles is None:
        raise InputError(
            subject,
            expected="faces of this scan, or their `triangles`",
            received="numbers of faces of another scan",
            remedy="correct it again with `smplxpp label RUN`, or remove the entry",
        )
    faces, share = nearest_faces(surface, item.triangles)
    warnings.warn(
        f"{subject}: the scan has changed since; its {len(item.faces)} faces are found again by their places: "
        f"{len(faces)} faces, {100 * share:.0f} % of their area",
        GeometryWarning,
        stacklevel=3,
    )
    return faces


# -- the file


def _read(row: Any, subject: str, labels: Labels) -> Correction:
    values = as_object(row, subject=subject)
    name = as_text(values.get("label"), subject=f"{subject}: label")
    label, kinds = labels.named(name, subject=f"{subject}: label").id, sorted(_KINDS & set(values))
    if len(kinds) != 1:
        raise InputError(subject, expected=f"one of {', '.join(sorted(_KINDS))}", received=", ".join(kinds) or "none")
    if kinds == ["faces"]:
        return _read_faces(values, label, subject)
    if kinds == ["box"]:
        return _read_box(as_object(values["box"], subject=f"{subject}: box"), label, f"{subject}: box")
    # A stroke: points more than 25 cm apart are not one stroke on a surface; a radius is 1 mm to 50 cm.
    points = _points(values["stroke"], f"{subject}: stroke")
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    longest = 0.25
    if (steps > longest).any():
        raise InputError(
            f"{subject}: stroke",
            expected=f"points at most {longest:g} m apart, along the surface",
            received=f"{steps.max():.3g} m",
        )
    radius = as_number(values.get("radius"), subject=f"{subject}: radius", least=0.001, most=0.5)
    normals = None
    if values.get("normals") is not None:
        normals = as_numbers(values["normals"], points.shape, subject=f"{subject}: normals")
    return StrokeCorrection(label, points, radius, normals)


def _read_faces(values: Mapping[str, Any], label: int, subject: str) -> FaceCorrection:
    listed = as_list(values["faces"], subject=f"{subject}: faces")
    most = 5_000_000  # faces of the largest scans
    if not 0 < len(listed) <= most:
        raise InputError(f"{subject}: faces", expected=f"1 to {most}", received=f"{len(listed)}")
    numbers = as_numbers(listed, (None,), subject=f"{subject}: faces")
    if (numbers < 0).any() or (numbers > 2**31).any() or (numbers != np.floor(numbers)).any():
        raise InputError(f"{subject}: faces", expected="whole numbers from 0", received="others")
    triangles = None
    if values.get("triangles") is not None:
        triangles = as_numbers(values["triangles"], (len(listed), 3, 3), subject=f"{subject}: triangles")
        _require_near(triangles, f"{subject}: triangles")
    scan = values.get("scan")
    digest = None if scan is None else as_text(scan, subject=f"{subject}: scan")
    return FaceCorrection(label, numbers.astype(np.int64), triangles, digest)


def _read_box(values: Mapping[str, Any], label: int, subject: str) -> BoxCorrection:
    def vector(name: str) -> Float64[np.ndarray, " 3"]:
        found = as_numbers(values.get(name), (3,), subject=f"{subject}: {name}")
        _require_near(found, f"{subject}: {name}")
        return found

    if "min" in values:
        low, high = vector("min"), vector("max")
        center, size, turn = 0.5 * (low + high), high - low, np.zeros(3)
    else:
        center, size = vector("center"), vector("size")
        turn = vector("rotvec") if "rotvec" in values else np.zeros(3)
    if not (size > 0).all():
        raise InputError(subject, expected="edges longer than 0", received=f"{np.array2string(size, precision=3)}")
    return BoxCorrection(label, center, size, matrix_from_rotvec(turn))


def _points(value: Any, subject: str) -> Float64[np.ndarray, "n 3"]:
    listed = as_list(value, subject=subject)
    most = 10_000
    if not 0 < len(listed) <= most:
        raise InputError(subject, expected=f"1 to {most} points", received=f"{len(listed)}")
    points = as_numbers(listed, (None, 3), subject=subject)
    _require_near(points, subject)
    return points


def _require_near(values: Float[np.ndarray, "*n"], subject: str) -> None:
    # A coordinate above 1 km is in millimetres, or damaged.
    if np.abs(values).max(initial=0.0) > 1e3:
        raise InputError(subject, expected="metres, as the run's scan has them", received=f"{np.abs(values).max():.3g}")


def _written(item: Correction, labels: Labels) -> dict[str, Any]:
    # Each kind of correction has a field of its own, which `_read` tells it by; metres have four digits or more.
    def rounded(values: Any, digits: int = 4) -> list:
        return np.round(values, digits).tolist()

    out: dict[str, Any] = {"label": labels[item.label].name}
    if isinstance(item, StrokeCorrection):
        out |= {"stroke": rounded(item.points), "radius": round(float(item.radius), 5)}
        return out if item.normals is None else out | {"normals": rounded(item.normals, 3)}
    if isinstance(item, BoxCorrection):
        turn = rotvec_from_matrix(item.rotation)
        if not np.any(np.abs(turn) > 1e-9):
            return out | {
                "box": {
                    "min": rounded(item.center - 0.5 * item.size, 5),
                    "max": rounded(item.center + 0.5 * item.size, 5),
                }
            }
        box = {"center": rounded(item.center, 5), "size": rounded(item.size, 5), "rotvec": rounded(turn, 6)}
        return out | {"box": box}
    out["faces"] = item.faces.tolist()
    if item.scan is not None:
        out["scan"] = item.scan
    return out if item.triangles is None else out | {"triangles": rounded(item.triangles)}
