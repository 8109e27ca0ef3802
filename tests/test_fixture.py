"""The shipped fixture person is consistent with itself: skinning, labels, scan, parameters."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import pytest

from smplxpp.body import load_body, skin
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_io import read_mesh
from smplxpp.core.params import BodyParams
from smplxpp.core.signed_distance import SignedDistanceField

FOLDER = Path(__file__).resolve().parents[1] / "data" / "fixtures" / "person"


@dataclass(frozen=True, eq=False)
class Person:
    topology: dict[str, np.ndarray]
    posed: np.ndarray
    params: BodyParams
    noisy: BodyParams

    def part(self, name: str, vertices: np.ndarray) -> TriangleMesh:
        index = self.topology["part_names"].tolist().index(name)
        return TriangleMesh(vertices, self.topology["faces"]).submesh(self.topology["face_part"] == index)[0]


def _load(name: str) -> dict[str, np.ndarray]:
    with np.load(FOLDER / name, allow_pickle=False) as data:
        return {key: data[key] for key in data.files}


@pytest.fixture(scope="module")
def person() -> Person:
    return Person(
        _load("geometry/topology.npz"),
        _load("geometry/frame_000000.npz")["verts"].astype(np.float64),
        BodyParams.from_mapping(_load("params/params.npz")),
        BodyParams.from_mapping(_load("params/params_noisy.npz")),
    )


@pytest.fixture(scope="module")
def scan() -> tuple[TriangleMesh, np.ndarray]:
    return read_mesh(FOLDER / "scans" / "scan_000000.ply").mesh, _load("scans/scan_000000_labels.npz")["label"]


def test_the_data_stay_small():
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < 5e6


def test_weights_are_a_partition_of_unity(person):
    weights = person.topology["weights"]
    assert weights.min() >= 0
    np.testing.assert_array_equal(weights.astype(np.float64).sum(axis=1), 1)


def test_posed_layers_are_skinning_of_the_tpose(person):
    body, first = load_body(), person.params.frame(0)
    forward = body.forward(first).frame(0)
    rest = person.topology["v_tpose"] + person.topology["exprdirs"] @ first.expression[0]
    np.testing.assert_allclose(rest[: body.vertex_count], forward.rest_vertices, atol=3e-5)
    posed = skin(rest, person.topology["weights"].astype(np.float64), forward.posed_from_rest)
    # Stored weights are multiples of 1/4096: far from the joints that is a tenth of a millimetre.
    np.testing.assert_allclose(posed, person.posed, atol=3e-4)
    np.testing.assert_allclose(forward.vertices, person.posed[: body.vertex_count], atol=2e-5)


def test_parts_do_not_share_vertices_and_carry_their_labels(person):
    topology = person.topology
    vertex_part = topology["vertex_part"][topology["faces"]]
    assert (vertex_part == topology["face_part"][:, None]).all()
    own = topology["part_label"][topology["vertex_part"]]
    differs = topology["vertex_label"] != own
    assert (topology["vertex_label"][differs] == 6).all()
    assert (topology["vertex_part"][differs] == 0).all()
    assert set(np.unique(topology["part_label"])) == {1, 2, 3, 4, 5}


@pytest.mark.parametrize("name", ["upper", "lower", "shoes", "hair"])
def test_clothes_lie_outside_the_body_in_the_tpose(person, name):
    vertices = person.topology["v_tpose"].astype(np.float64)
    field = SignedDistanceField(person.part("body", vertices), solid=True)
    part = person.part(name, vertices)
    distance = field.query(part.vertices).distance
    assert distance.min() > 0.0 if name != "hair" else distance.min() > -0.002
    assert np.percentile(distance, 1) > 0.002
    assert (part.edges_with_counts[1] <= 2).all()


def test_skirt_weights_are_smooth_from_one_leg_to_the_other(person):
    index = person.topology["part_names"].tolist().index("lower")
    skirt, used = TriangleMesh(person.topology["v_tpose"], person.topology["faces"]).submesh(
        person.topology["face_part"] == index
    )
    weights, edges = person.topology["weights"][used], skirt.edges
    change = 0.5 * np.abs(weights[edges[:, 0]] - weights[edges[:, 1]]).sum(axis=1)
    assert change.max() < 0.15


def test_scan_is_one_closed_outward_surface(scan):
    mesh, labels = scan
    assert (mesh.edges_with_counts[1] == 2).all()
    volume = np.einsum("ij,ij->", mesh.triangles.mean(axis=1), mesh.face_cross) / 6
    assert 0.05 < volume < 0.15  # cubic metres: a person with the air under her skirt
    assert len(labels) == mesh.vertex_count
    assert set(np.unique(labels)) <= set(range(1, 7))
    assert {1, 2, 3, 4, 5} <= set(np.unique(labels))


@pytest.mark.parametrize(("label", "name"), [(2, "hair"), (3, "shoes"), (4, "upper"), (5, "lower")])
def test_scan_lies_on_its_layers(person, scan, label, name):
    mesh, labels = scan
    part = person.part(name, person.posed)
    points = mesh.vertices[labels == label]
    distance = np.sqrt(igl.point_mesh_squared_distance(points, part.vertices, part.faces)[0]) * 1e3
    # Cloth is given a thickness for the scan and webs leave the layers, so the mean is above the noise.
    assert np.median(distance) < 1.0
    assert distance.mean() < 5.0


def test_scan_has_colours_of_its_own():
    colors = read_mesh(FOLDER / "scans" / "scan_000000.ply").vertex_colors
    assert colors is not None and len(np.unique(colors // 16, axis=0)) > 50


def test_motion_starts_neutral_stands_on_the_floor_and_is_varied(person):
    assert len(person.params) == len(person.noisy) == 24
    assert not person.params.expression[0].any()
    # Shoes are the lowest layer, y = 0.
    assert person.posed[:, 1].min() == pytest.approx(0, abs=1e-4)
    assert np.ptp(person.params.full_pose, axis=0).max() > np.radians(80)
    error = load_body().forward(person.noisy).vertices - load_body().forward(person.params).vertices
    mean = np.linalg.norm(error, axis=-1).mean()
    assert 0.008 < mean < 0.06
