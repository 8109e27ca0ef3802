"""Scans as files have them: colours of split vertices, clouds of points with labels, what is refused."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from pipelines.stages.build import build
from pipelines.stages.build_config import BuildConfig, BuildInputs
from smplxpp.build.scan import read_scan
from smplxpp.core import GeometryWarning, InputError, MissingExtraError, TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh, write_ply
from smplxpp.metrics import point_to_surface, sample_surface
from smplxpp.segment.label_files import read_labels

FIXTURE = Path(__file__).resolve().parents[3] / "data" / "fixtures" / "person"
POINTS = 12000


@pytest.fixture(scope="module")
def cloud() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the fixture's scan, and the label and the colour of the nearest of its vertices."""
    file = read_mesh(FIXTURE / "scans" / "scan_000000.ply")
    samples = sample_surface(file.mesh, POINTS, seed=0)
    corner = file.mesh.faces[samples.face, 0]
    with np.load(FIXTURE / "scans" / "scan_000000_labels.npz") as labels:
        return samples.points, labels["label"][corner], file.vertex_colors[corner]


def quiet_scan(path: Path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        return read_scan(path, **options)


def test_colours_of_vertices_that_lie_together_are_averaged(tmp_path: Path):
    corners = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 1.7, 0.1], [0, 1.7, 0]], dtype=float)
    vertices, faces = corners[[0, 1, 2, 0, 2, 3]], np.array([[0, 1, 2], [3, 4, 5]])
    colors = np.array([10, 20, 30, 50, 31, 60], np.uint8)[:, None].repeat(3, axis=1)
    np.savez(tmp_path / "s.npz", vertices=vertices, faces=faces, colors=colors)
    scan = quiet_scan(tmp_path / "s.npz")
    np.testing.assert_array_equal(scan.clean.mesh.vertices, corners)
    np.testing.assert_array_equal(scan.colors[:, 0], [30, 20, 30, 60])  # 30.5 rounds to the even number
    np.savez(tmp_path / "s.npz", vertices=vertices, faces=faces)
    assert quiet_scan(tmp_path / "s.npz").colors is None


@pytest.mark.parametrize(("units", "scale", "up"), [("m", 1.0, "y"), ("cm", 100.0, "z")])
def test_a_cloud_becomes_a_scan_in_metres_whose_vertices_are_points(
    tmp_path: Path, cloud, units: str, scale: float, up: str
):
    pytest.importorskip("open3d", exc_type=ImportError)
    points, _, colors = cloud
    turned = points if up == "y" else points[:, [0, 2, 1]] * [1, -1, 1]
    empty = np.empty((0, 3), np.int64)
    write_ply(tmp_path / "c.ply", TriangleMesh(turned * scale, empty), vertex_colors=colors)
    with pytest.warns(GeometryWarning, match=r"c\.ply: point cloud of 12000 points"):
        scan = read_scan(tmp_path / "c.ply", units=units, up=up)
    assert scan.raw.is_cloud and scan.clean.mesh.face_count > POINTS
    nearest = np.linalg.norm(points[scan.clean.source_vertex] - scan.clean.mesh.vertices, axis=1)
    assert np.median(nearest) < 0.01
    np.testing.assert_array_equal(scan.colors, colors[scan.clean.source_vertex])
    assert np.mean(point_to_surface(points, scan.clean.mesh)[0]) < 0.003
    assert quiet_scan(tmp_path / "c.ply", units=units, up=up).clean.mesh.face_count == scan.clean.mesh.face_count
    if units == "cm":
        with pytest.raises(InputError, match="--units cm"):
            quiet_scan(tmp_path / "c.ply", up=up)


def test_labels_of_points_reach_the_parts_and_labels_of_others_are_refused(tmp_path: Path, cloud):
    pytest.importorskip("open3d", exc_type=ImportError)
    points, labels, colors = cloud
    np.savez(tmp_path / "c.npz", points=points, colors=colors)
    np.savez(tmp_path / "l.npz", label=labels)
    inputs = BuildInputs(
        "cloud",
        tmp_path / "c.npz",
        FIXTURE / "params" / "params.npz",
        labels=tmp_path / "l.npz",
        label_set="capture",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        build(tmp_path / "run", inputs, BuildConfig(), last="30_clean")
    with (
        np.load(tmp_path / "run" / "20_segment" / "labels.npz") as found,
        np.load(tmp_path / "run" / "08_capture" / "scan.npz") as scan,
    ):
        face_labels, source = found["face_labels"], scan["scan/source_vertex"]
        faces = scan["scan/faces"]
    of_points = read_labels(tmp_path / "l.npz", vertex_count=POINTS, face_count=0, label_set="capture")
    agree = (of_points[source][faces] == face_labels[:, None]).mean()
    assert agree > 0.97
    np.savez(tmp_path / "l.npz", label=labels[:-1])
    with pytest.raises(InputError, match=f"{POINTS} labels"), warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        build(tmp_path / "run", inputs, BuildConfig(), last="30_clean")


def test_a_cloud_without_open3d_says_what_to_type(tmp_path: Path, cloud, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    np.savez(tmp_path / "other.npz", points=cloud[0])
    with pytest.raises(MissingExtraError, match=r"extra scan"):
        read_scan(tmp_path / "other.npz")
