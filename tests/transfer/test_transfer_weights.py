"""Invariants of skin-weight transfer, on a small body of two limbs and what it wears."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.spatial.transform import Rotation

from smplxpp.core import InputError, TriangleMesh, concatenate_meshes
from smplxpp.transfer import TransferConfig, transfer_weights
from smplxpp.transfer.checks import extent
from smplxpp.transfer.correspond import closest_points

NAMES = ("hips", "left", "right", "hand")
CONFIGS = {"default": TransferConfig(), "paper": TransferConfig.paper()}


def tube(radius: float, low: float, high: float, *, around: int = 24, along: int = 30, x: float = 0.0) -> TriangleMesh:
    """An open vertical cylinder, normals outwards, slightly crumpled so that nothing is symmetric."""
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(low, high, along))
    r = radius * (1 + 0.05 * np.sin(3 * angle + 7 * height))
    points = np.stack([x + r * np.cos(angle), height, r * np.sin(angle)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(along - 1))
    a, b = (j * around + i).ravel(), (j * around + (i + 1) % around).ravel()
    faces = np.concatenate([np.stack([a, a + around, b], 1), np.stack([b, a + around, b + around], 1)])
    return TriangleMesh(points, faces)


@pytest.fixture(scope="module")
def body() -> tuple[TriangleMesh, np.ndarray]:
    """Two legs at x = -0.1 and 0.1 that blend into the hips at the top, and a hand beside them at x = 0.4."""
    legs = [tube(0.08, 0.0, 1.0, x=x) for x in (0.1, -0.1)]
    hand = tube(0.03, 0.4, 0.7, along=10, x=0.26)
    mesh = concatenate_meshes([*legs, hand])
    weights = np.zeros((mesh.vertex_count, 4))
    for k, leg in enumerate(legs):
        share = np.clip((leg.vertices[:, 1] - 0.7) / 0.2, 0, 1)
        rows = slice(k * leg.vertex_count, (k + 1) * leg.vertex_count)
        weights[rows, 0], weights[rows, 1 + k] = share, 1 - share
    weights[-hand.vertex_count :, 3] = 1
    return mesh, weights


@pytest.fixture(scope="module")
def skirt() -> TriangleMesh:
    return tube(0.22, 0.1, 0.95, around=40)


@pytest.mark.parametrize("name", CONFIGS)
def test_a_mesh_gives_itself_its_own_weights(body, name):
    mesh, weights = body
    result = transfer_weights(mesh, weights, mesh, config=CONFIGS[name])
    assert np.abs(result.dense() - weights).max() < 1e-9
    assert result.matched.all() and set(result.policies) == {"matched"}


@pytest.mark.parametrize("name", CONFIGS)
def test_rows_are_partitions_of_unity(body, skirt, name):
    dense = transfer_weights(*body, skirt, config=CONFIGS[name]).dense()
    assert np.abs(dense.sum(axis=1) - 1).max() < 1e-12 and dense.min() >= 0


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("scale", [100.0, 1000.0])
def test_the_unit_does_not_matter(body, skirt, name, scale):
    mesh, weights = body
    metres = transfer_weights(mesh, weights, skirt, config=CONFIGS[name]).dense()
    other = transfer_weights(
        mesh.with_vertices(scale * mesh.vertices),
        weights,
        skirt.with_vertices(scale * skirt.vertices),
        config=CONFIGS[name],
    ).dense()
    assert np.abs(metres - other).max() < 1e-6


@pytest.mark.parametrize("name", CONFIGS)
def test_a_rigid_motion_does_not_matter(body, skirt, name):
    mesh, weights = body
    rotation = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    moved = [m.with_vertices(m.vertices @ rotation.T + [3.0, -1.0, 0.5]) for m in (mesh, skirt)]
    still = transfer_weights(mesh, weights, skirt, config=CONFIGS[name]).dense()
    assert np.abs(still - transfer_weights(moved[0], weights, moved[1], config=CONFIGS[name]).dense()).max() < 1e-6


@pytest.mark.parametrize("name", CONFIGS)
def test_the_order_of_vertices_does_not_matter(body, skirt, name):
    mesh, weights = body
    rng = np.random.default_rng(3)

    def shuffled(m: TriangleMesh) -> tuple[TriangleMesh, np.ndarray]:
        order = rng.permutation(m.vertex_count)
        return TriangleMesh(m.vertices[order], np.argsort(order)[m.faces]), order

    (other_mesh, order), (other_skirt, skirt_order) = shuffled(mesh), shuffled(skirt)
    expected = transfer_weights(mesh, weights, skirt, config=CONFIGS[name]).dense()
    found = transfer_weights(other_mesh, weights[order], other_skirt, config=CONFIGS[name]).dense()
    assert np.abs(found - expected[skirt_order]).max() < 1e-6


def test_inpainting_is_the_constrained_minimum_that_libigl_finds(body, skirt):
    """Another solver on the published energy, as an oracle of the paper's settings."""
    mesh, weights = body
    config = TransferConfig(
        falloff=None,
        smoothing=None,
        published=0.0,
        unmatched="nearest",
        laplacian="cotangent",
        max_influences=None,
        max_distance=0.08,
    )
    result = transfer_weights(mesh, weights, skirt, config=config)
    assert 0.05 < result.matched.mean() < 0.95
    c = igl.cotmatrix(skirt.vertices, skirt.faces)
    m = igl.massmatrix(skirt.vertices, skirt.faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    length = 0.4 * extent(mesh)
    q = sp.csc_matrix(-c + length**2 * (c @ sp.diags(1 / m) @ c))
    dense = result.dense()
    known = np.flatnonzero(result.matched)
    n = skirt.vertex_count
    expected = igl.min_quad_with_fixed(
        q, np.zeros((n, 4)), known, dense[known], sp.csc_matrix((0, n)), np.zeros((0, 4)), True
    )
    expected = np.clip(expected, 0, 1)
    assert np.abs(expected / expected.sum(axis=1, keepdims=True) - dense).max() < 1e-6


def test_a_loose_skirt_blends_the_legs_where_the_nearest_point_tears(body, skirt):
    """Between the legs the jump from one leg to the other is spread over several edges."""
    mesh, weights = body
    config = TransferConfig(allowed_joints=("hips", "left", "right"), joint_names=NAMES)
    dense = transfer_weights(mesh, weights, skirt, config=config).dense()
    middle = np.abs(skirt.vertices[skirt.edges].mean(axis=1)[:, 0]) < 0.05
    low = skirt.vertices[skirt.edges].mean(axis=1)[:, 1] < 0.6
    jump = np.abs(dense[skirt.edges[:, 0], 1] - dense[skirt.edges[:, 1], 1])[middle & low]
    assert 0.05 < jump.max() < 0.45
    side = skirt.vertices[:, 0] > 0.2
    # As much as those who author skirts let the leg count.
    assert (dense[side & (skirt.vertices[:, 1] < 0.6), 1] > 0.8).all()


def test_a_forbidden_limb_is_never_followed(body, skirt):
    mesh, weights = body
    assert closest_points(mesh, skirt).interpolate(mesh, weights)[:, 3].max() > 0.5  # the hand touches the skirt
    assert transfer_weights(mesh, weights, skirt).dense()[:, 3].max() > 0.1  # without a label it counts a little
    config = TransferConfig(allowed_joints=("hips", "left", "right"), joint_names=NAMES)
    assert transfer_weights(mesh, weights, skirt, config=config).dense()[:, 3].max() == 0


def test_the_published_answer_has_its_share_off_the_skin_alone(body):
    mesh, weights = body
    skirt = tube(0.19, 0.1, 0.95, around=40)  # so close to the legs' sides that some of it is confident
    near = closest_points(mesh, skirt).distance < 0.01 * extent(mesh)
    far = closest_points(mesh, skirt).distance > 0.08 * extent(mesh)
    assert near.any() and far.any()
    none, half, whole = (
        transfer_weights(mesh, weights, skirt, config=TransferConfig(published=share, max_influences=None)).dense()
        for share in (0.0, 0.35, 0.7)  # 0.7 near the skin is 0.98 far off
    )
    paper = replace(TransferConfig.paper(), max_influences=None, length_scale=TransferConfig().published_length)
    published = transfer_weights(mesh, weights, skirt, config=paper)
    np.testing.assert_allclose(whole[near], none[near], atol=1e-12)
    np.testing.assert_allclose(half, 0.5 * (none + whole), atol=1e-9)
    apart = np.abs(whole - published.dense())[far]
    assert apart.mean() < 0.1 * np.abs(none - published.dense())[far].mean() + 1e-3
    with pytest.raises(InputError, match="published"):
        TransferConfig(published=1.5)


def test_the_published_share_follows_no_forbidden_limb(body):
    """A wide skirt has the hand inside, which faces as it does: the published answer alone follows it."""
    mesh, weights = body
    wide = tube(0.33, 0.1, 0.95, around=48)
    free = transfer_weights(mesh, weights, wide, config=TransferConfig.paper()).dense()
    assert free[:, 3].max() > 0.5
    config = TransferConfig(allowed_joints=("hips", "left", "right"), joint_names=NAMES, published=1.0)
    dense = transfer_weights(mesh, weights, wide, config=config).dense()
    assert dense[:, 3].max() < 1e-3
    np.testing.assert_allclose(dense.sum(axis=1), 1, atol=1e-12)


def test_a_confident_match_keeps_its_joints_whatever_is_allowed(body):
    """A close stocking on the left leg keeps `left`, although only hips and the other leg are allowed."""
    mesh, weights = body
    stocking = tube(0.09, 0.1, 0.6, x=0.1)
    config = TransferConfig(allowed_joints=("hips", "right"), joint_names=NAMES)
    assert transfer_weights(mesh, weights, stocking, config=config).dense()[:, 1].min() > 0.95
    overruled = replace(config, confident=None)
    assert transfer_weights(mesh, weights, stocking, config=overruled).dense()[:, 1].max() == 0


def test_cloth_that_lies_on_the_skin_elsewhere_does_not_follow_the_hand_beside_it(body):
    """A close skirt has anchor weights of the legs all over; the hand that nearly touches it faces against it."""
    mesh, weights = body
    angle = np.arange(48) * (2 * np.pi / 48)
    sheet = tube(0.2, 0.1, 0.95, around=48)
    # An oval round both legs, 1 cm off their outer sides.
    flat = np.stack([0.19 * np.cos(angle), 0.09 * np.sin(angle)], axis=1)
    points = sheet.vertices.copy()
    points[:, [0, 2]] = np.tile(flat, (30, 1))
    points[:, 0] += 0.004 * np.sin(9 * points[:, 1])
    skirt = sheet.with_vertices(points)
    hand = tube(0.03, 0.4, 0.7, along=10, x=0.228)
    rows = len(weights) - hand.vertex_count
    near = mesh.with_vertices(np.concatenate([mesh.vertices[:rows], hand.vertices]))
    assert transfer_weights(near, weights, skirt).dense()[:, 3].max() < 0.02
    assert transfer_weights(near, weights, skirt, config=TransferConfig.restricted()).dense()[:, 3].max() > 0.3


def test_what_hangs_about_a_forbidden_limb_alone_has_weights_all_the_same(body):
    """A flat ring that touches the hand, labelled as what cannot follow it; no match is confident."""
    mesh, weights = body
    inner = mesh.vertices[-5 * 24 : -4 * 24]  # a row of the hand's own
    outer = inner + 0.5 * (inner - inner.mean(axis=0))
    ring = TriangleMesh(np.concatenate([inner, outer]), tube(1.0, 0.0, 1.0, along=2).faces)
    config = TransferConfig(allowed_joints=("hips",), joint_names=NAMES)
    dense = transfer_weights(mesh, weights, ring, config=config).dense()
    assert np.isfinite(dense).all() and np.abs(dense.sum(axis=1) - 1).max() < 1e-12


def test_labels_name_joints_of_the_model_by_their_number():
    config = TransferConfig.for_label("lower")
    mask = config.allowed_mask(55)
    assert mask[[0, 1, 2, 4, 5]].all() and not mask[[15, 18, 20]].any() and not mask[25:].any()
    assert TransferConfig.for_label("skin").allowed_mask(55) is None
    with pytest.raises(InputError, match="tail"):
        TransferConfig(allowed_joints=("tail",)).allowed_mask(55)


def test_influences_are_limited(body, skirt):
    result = transfer_weights(*body, skirt, config=TransferConfig(max_influences=2))
    assert result.joint_indices.shape[1] <= 2
    assert np.abs(result.dense().sum(axis=1) - 1).max() < 1e-12


def test_averaging_moves_unmatched_vertices_only(body, skirt):
    plain = transfer_weights(*body, skirt, config=TransferConfig.paper())
    smoothed = transfer_weights(
        *body,
        skirt,
        config=TransferConfig(falloff=None, smoothing=None, unmatched="nearest", normal_widening=0, averaging_steps=5),
    )
    change = np.abs(plain.dense() - smoothed.dense()).max(axis=1)
    assert change[plain.matched].max() < 1e-12 and change[~plain.matched].max() > 1e-4


def test_provenance_is_recorded(body, skirt):
    result = transfer_weights(*body, skirt)
    assert result.distance.min() >= 0 and np.isfinite(result.angle).all() and len(result.policies) == 1
    far = transfer_weights(*body, skirt, config=TransferConfig(max_distance=0.01))
    assert far.matched.sum() < result.matched.sum()
