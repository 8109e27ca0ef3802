"""Meshes as they come: every flaw ends in a clear error or a stated repair, never in silent zeros."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from smplxpp.body import load_body
from smplxpp.core import GeometryWarning, InputError, TriangleMesh, concatenate_meshes
from smplxpp.people.garments.loose import layered_garments, loose_garments
from smplxpp.people.garments.mannequin import Mannequin, lowered
from smplxpp.people.garments.wardrobe import shape_betas
from smplxpp.transfer import TransferConfig, transfer_weights
from smplxpp.transfer.checks import check_placement, consistent_winding
from smplxpp.transfer.correspond import closest_points
from smplxpp.transfer.inpaint import edge_lengths, laplacian_and_mass, mollify


def sphere(radius: float = 1.0, center=(0.0, 0.0, 0.0), n: int = 16) -> TriangleMesh:
    """A closed sphere of n rings, normals outwards, stretched along y so that its axes differ."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, n + 1)[1:-1], np.linspace(0, 2 * np.pi, 2 * n, endpoint=False))
    ring = np.stack([np.sin(theta) * np.cos(phi), 3 * np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    points = np.concatenate([ring.transpose(1, 0, 2).reshape(-1, 3), [[0, 3, 0], [0, -3, 0]]])
    m = 2 * n
    i, j = np.meshgrid(np.arange(m), np.arange(n - 2))
    a, b = (j * m + i).ravel(), (j * m + (i + 1) % m).ravel()
    k = np.arange(m)
    top, bottom, last = len(points) - 2, len(points) - 1, (n - 2) * m
    faces = np.concatenate(
        [
            np.stack([a, b, a + m], 1),
            np.stack([b, b + m, a + m], 1),
            np.stack([np.full(m, top), (k + 1) % m, k], 1),
            np.stack([np.full(m, bottom), last + k, last + (k + 1) % m], 1),
        ]
    )
    return TriangleMesh(np.array(center) + radius * points, faces)


SOURCE = sphere()
WEIGHTS = np.stack([x := np.clip(0.5 + SOURCE.vertices[:, 1] / 6, 0, 1), 1 - x], axis=1)
COAT = sphere(1.05)


def assert_whole(result) -> None:
    dense = result.dense()
    assert np.isfinite(dense).all() and dense.min() >= 0
    assert np.abs(dense.sum(axis=1) - 1).max() < 1e-12


def test_unreferenced_vertices_get_weights():
    target = TriangleMesh(np.concatenate([COAT.vertices, [[0, 2.9, 0.1], [0, -2.9, 0.1]]]), COAT.faces)
    result = transfer_weights(SOURCE, WEIGHTS, target)
    assert_whole(result)
    assert result.dense()[-2, 0] > 0.8 and result.dense()[-1, 1] > 0.8
    assert not result.matched[-2:].any()
    with pytest.warns(GeometryWarning, match="2 of 3 components"):
        assert_whole(transfer_weights(SOURCE, WEIGHTS, target, config=TransferConfig.paper()))


def test_unreferenced_source_vertices_are_not_read():
    source = TriangleMesh(np.concatenate([SOURCE.vertices, [[9.0, 9.0, 9.0]]]), SOURCE.faces)
    result = transfer_weights(source, np.concatenate([WEIGHTS, [[np.nan, 0]]]), COAT)
    assert np.abs(result.dense() - transfer_weights(SOURCE, WEIGHTS, COAT).dense()).max() < 1e-12


@pytest.mark.parametrize("config", [TransferConfig(), TransferConfig.paper()], ids=["default", "paper"])
def test_zero_area_faces(config):
    extra = np.array([[0, 0, 1], [5, 6, 5], [10, 10, 10]])
    bent = COAT.vertices.copy()
    bent[40] = bent[41]  # two vertices at one place: slivers around them
    target = TriangleMesh(bent, np.concatenate([COAT.faces, extra]))
    assert_whole(transfer_weights(SOURCE, WEIGHTS, target, config=config))


def test_mollified_faces_are_proper_and_good_ones_untouched():
    lengths = edge_lengths(COAT)
    assert np.array_equal(mollify(lengths), lengths)
    collapsed = np.concatenate([lengths, [[1.0, 1.0, 0.0], [2.0, 1.0, 1.0], [0.0, 0.0, 0.0]]])
    fixed = mollify(collapsed)
    assert (fixed.sum(axis=1, keepdims=True) - 2 * fixed).min() > 0


def test_the_intrinsic_laplacian_has_no_negative_weights():
    rng = np.random.default_rng(0)
    crumpled = COAT.with_vertices(COAT.vertices + 0.08 * rng.standard_normal(COAT.vertices.shape))
    given, _ = laplacian_and_mass(crumpled, kind="cotangent")
    better, mass = laplacian_and_mass(crumpled, kind="intrinsic")

    def least(matrix) -> float:
        coo = matrix.tocoo()
        return coo.data[coo.row != coo.col].min()

    assert least(given) < -0.1 and least(better) > -1e-9
    assert mass.min() > 0 and np.abs(better.sum(axis=1)).max() < 1e-9


@pytest.mark.parametrize(
    ("policy", "expected"),
    [("extend", "extend"), ("nearest", "nearest"), ("rigid:1", "rigid:1"), ("rigid:tip", "rigid:tip")],
)
def test_a_component_without_a_match_gets_its_stated_policy(policy, expected):
    far = sphere(0.1, center=(2.5, 2.0, 0.0), n=6)
    target = concatenate_meshes([COAT, far])
    config = TransferConfig(unmatched=policy, joint_names=("base", "tip"))
    if policy == "nearest":
        with pytest.warns(GeometryWarning, match="1 of 2 components"):
            result = transfer_weights(SOURCE, WEIGHTS, target, config=config)
    else:
        result = transfer_weights(SOURCE, WEIGHTS, target, config=config)
    assert_whole(result)
    assert result.policies == ("matched", policy)
    if policy.startswith("rigid"):
        assert (result.dense()[COAT.vertex_count :, 1] == 1).all()


def test_a_component_without_a_match_can_be_refused():
    target = concatenate_meshes([COAT, sphere(0.1, center=(2.5, 2.0, 0.0), n=6)])
    with pytest.raises(InputError, match="1 of 2 components"):
        transfer_weights(SOURCE, WEIGHTS, target, config=TransferConfig(unmatched="raise"))


def test_inconsistent_winding_is_turned_with_a_warning():
    faces = COAT.faces.copy()
    faces[::7] = faces[::7][:, ::-1]
    with pytest.warns(GeometryWarning, match=f"{len(faces[::7])} of {len(faces)} faces"):
        result = transfer_weights(SOURCE, WEIGHTS, TriangleMesh(COAT.vertices, faces))
    assert np.abs(result.dense() - transfer_weights(SOURCE, WEIGHTS, COAT).dense()).max() < 1e-9


def test_consistent_winding_is_left_alone():
    assert consistent_winding(COAT, subject="mesh") is COAT


@pytest.mark.parametrize("config", [TransferConfig(), TransferConfig.paper()], ids=["default", "paper"])
def test_a_target_inside_out_is_turned_with_a_warning(config):
    inverted = TriangleMesh(COAT.vertices, COAT.faces[:, ::-1])
    with pytest.warns(GeometryWarning, match="inside out"):
        result = transfer_weights(SOURCE, WEIGHTS, inverted, config=config)
    assert np.abs(result.dense() - transfer_weights(SOURCE, WEIGHTS, COAT, config=config).dense()).max() < 1e-6


def test_a_closed_bag_on_the_back_is_not_inside_out():
    """The side that lies on the body faces against it; the volume that the bag encloses says which way is out."""
    bag = trimesh.creation.box((0.3, 0.3, 0.12)).subdivide().subdivide().subdivide()
    lying = TriangleMesh(bag.vertices + [0, 0, SOURCE.vertices[:, 2].min() - 0.062], bag.faces)
    weights = transfer_weights(SOURCE, WEIGHTS, lying)  # a warning would be an error
    # The side on the back is turned away from it: nothing there is matched as if it were cloth.
    assert np.degrees(weights.angle[lying.vertices[:, 2] > lying.vertices[:, 2].max() - 1e-6]).min() > 90
    inverted = TriangleMesh(lying.vertices, lying.faces[:, ::-1])
    with pytest.warns(GeometryWarning, match=f"{lying.vertex_count} of {lying.vertex_count} vertices"):
        turned = transfer_weights(SOURCE, WEIGHTS, inverted)
    assert np.abs(turned.dense() - weights.dense()).max() < 1e-9


@pytest.mark.parametrize("scale", [0.001, 0.01, 100.0, 1000.0])
def test_other_units_are_named(scale):
    with pytest.raises(InputError, match=f"multiply the target's coordinates by {1 / scale:g}"):
        transfer_weights(SOURCE, WEIGHTS, COAT.with_vertices(scale * COAT.vertices))


def test_other_axes_are_named():
    cap, _ = COAT.submesh(COAT.triangles[:, :, 1].mean(axis=1) > 1.5)
    swapped = cap.with_vertices(cap.vertices[:, [0, 2, 1]] * [1, -1, 1])
    with pytest.raises(InputError, match=r"\+Z up"):
        transfer_weights(SOURCE, WEIGHTS, swapped)


def test_a_wide_flat_skirt_has_no_other_axes():
    """A tutu on a heavy person would lie nearer to a body that it cut from head to foot, and was refused."""
    body = load_body()
    heavy = Mannequin.of(body, shape_betas(body, "heavy and tall"))
    tutu = next(garment for garment in loose_garments(heavy) + layered_garments(heavy) if garment.name == "tutu").cloth
    source = body.mesh(body.forward(lowered(heavy, 50.0)).vertices[0])
    # Its outer part alone is as far off as a scan of it, whose vertices are spread evenly.
    rim = tutu.mesh.submesh(np.linalg.norm(tutu.mesh.face_centers[:, [0, 2]], axis=1) > 0.25)[0]
    check_placement(source, rim, closest_points(source, rim).distance)


def test_another_place_is_refused():
    with pytest.raises(InputError, match="translation"):
        transfer_weights(SOURCE, WEIGHTS, COAT.with_vertices(COAT.vertices + [20.0, 0, 0]))


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (WEIGHTS[:-1], "shape"),
        (np.where(np.arange(len(WEIGHTS))[:, None] == 3, np.nan, WEIGHTS), "vertex 3"),
        (WEIGHTS * 0.5, "sum 0.5"),
        (WEIGHTS + [0.2, -0.2], "negative"),
    ],
    ids=["shape", "nan", "sum", "negative"],
)
def test_bad_source_weights(weights, message):
    with pytest.raises(InputError, match=message):
        transfer_weights(SOURCE, weights, COAT)


def test_meshes_without_faces():
    empty = TriangleMesh(np.zeros((3, 3)), np.zeros((0, 3), dtype=np.int64))
    with pytest.raises(InputError, match="source mesh"):
        transfer_weights(empty, np.ones((3, 1)), COAT)
    with pytest.raises(InputError, match="target mesh"):
        transfer_weights(SOURCE, WEIGHTS, empty)


@pytest.mark.parametrize(
    "settings_",
    [
        {"falloff": 2.0},
        {"smoothing": 0.0},
        {"unmatched": "zero"},
        {"max_influences": 0},
        {"falloff": None},
        {"confident": 0.0},
        {"far": (0.1, 0.1)},
    ],
)
def test_bad_settings(settings_):
    with pytest.raises(InputError, match="config"):
        TransferConfig(**settings_)


@pytest.mark.filterwarnings("ignore::smplxpp.core.errors.GeometryWarning")  # torn-off pieces may lie inside out
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), noise=st.floats(0, 0.3), drop=st.floats(0, 0.6))
def test_any_crumpled_torn_mesh_gets_whole_rows(seed, noise, drop):
    rng = np.random.default_rng(seed)
    points = COAT.vertices + noise * rng.standard_normal(COAT.vertices.shape)
    target = TriangleMesh(points, COAT.faces[rng.random(COAT.face_count) >= drop])
    assert_whole(transfer_weights(SOURCE, WEIGHTS, target))
