"""Bridges of a scan between facing limbs are cut, real cloth over gaps, on shoulders and in folds is not."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.clean import BridgeConfig, cut_bridges, find_bridges, find_tears
from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.topology import border_loops, edge_groups

TRUNK, ARM = 0.15, 0.05
"""Radii of two upright cylinders, metres: a trunk and an arm that hangs beside it; the gap between them is 2 cm."""
GAP = 0.02
AXIS = TRUNK + GAP + ARM


def grid(points: np.ndarray) -> TriangleMesh:
    """A sheet through (R, C, 3) points, rows upwards, normals to the right of the rows' direction."""
    rows, columns = points.shape[:2]
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = i * columns + j
    b, c, d = a + 1, a + columns, a + columns + 1
    faces = np.concatenate([np.stack([a, b, d], 2), np.stack([a, d, c], 2)]).reshape(-1, 3)
    return TriangleMesh(points.reshape(-1, 3), faces)


def cylinder(radius: float, center: float) -> TriangleMesh:
    """Upright, 40 cm, about (center, 0, 0), normals outwards."""
    angle = np.linspace(0.0, -2.0 * np.pi, 65)
    height = np.linspace(0.0, 0.4, 30)
    circle = np.stack([center + radius * np.cos(angle), 0 * angle, radius * np.sin(angle)], axis=1)
    return grid(circle + height[:, None, None] * np.array([0.0, 1.0, 0.0]))


def both(first: TriangleMesh, second: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(
        np.concatenate([first.vertices, second.vertices]),
        np.concatenate([first.faces, second.faces + first.vertex_count]),
    )


def lifted(vertices: np.ndarray, share: np.ndarray) -> np.ndarray:
    """The arm goes 30 cm sideways; `share` of it at each vertex."""
    return vertices + share[:, None] * np.array([0.3, 0.0, 0.0])


@pytest.fixture(scope="module")
def body() -> tuple[TriangleMesh, TriangleMesh]:
    """Trunk and arm in the pose and at rest."""
    trunk, arm = cylinder(TRUNK, 0.0), cylinder(ARM, AXIS)
    posed = both(trunk, arm)
    share = np.repeat([0.0, 1.0], [trunk.vertex_count, arm.vertex_count])
    return posed, posed.with_vertices(lifted(posed.vertices, share))


def sheet(path: np.ndarray, rows: int = 21) -> TriangleMesh:
    """A sheet of height 20 cm over a horizontal path (C, 2) of x and z; its outside is on the path's right."""
    points = np.stack([path[:, 0], 0 * path[:, 0], path[:, 1]], axis=1)
    return grid(points + np.linspace(0.1, 0.3, rows)[:, None, None] * np.array([0.0, 1.0, 0.0]))


def inside_the_gap(columns: int = 8) -> TriangleMesh:
    """Cloth on the trunk, straight across the gap, on along the arm: a shirt as the scan has it.

    The cloth lies 2 mm off either; it crosses at the narrowest place, where trunk and arm face each other.
    """
    off = 0.002
    trunk = np.linspace(-1.2, 0.0, 60)
    along = (TRUNK + off) * np.stack([np.cos(trunk), np.sin(trunk)], axis=1)
    across = np.stack([np.linspace(TRUNK + off, AXIS - ARM - off, columns), np.zeros(columns)], axis=1)[1:-1]
    arm = np.pi + np.linspace(0.0, 1.2, 30)
    back = np.stack([AXIS + (ARM + off) * np.cos(arm), (ARM + off) * np.sin(arm)], axis=1)
    return sheet(np.concatenate([along, across, back])[::-1])


def torn(cloth: TriangleMesh, width: float = 0.0) -> TriangleMesh:
    """Unposed with weights that go from trunk to arm over `width` metres about the middle of the gap."""
    middle = TRUNK + GAP / 2
    x = cloth.vertices[:, 0]
    share = (x > middle).astype(float) if not width else np.clip((x - middle) / width + 0.5, 0.0, 1.0)
    return cloth.with_vertices(lifted(cloth.vertices, share))


def test_the_bridge_between_two_limbs_is_found_and_nothing_else(body):
    cloth = inside_the_gap()
    bridge = find_bridges(cloth, torn(cloth), *body)
    x = cloth.triangles[:, :, 0]
    over_the_middle = (x.min(axis=1) < TRUNK + GAP / 2) & (x.max(axis=1) > TRUNK + GAP / 2)
    assert bridge.any() and not (bridge & ~over_the_middle).any()
    # From the lower end to the upper one: what is cut is two pieces afterwards.
    rows = np.unique(cloth.face_centers[bridge, 1].round(2))
    np.testing.assert_allclose(rows[[0, -1]], [0.1, 0.3], atol=0.011)


def test_units_and_place_do_not_matter(body):
    cloth = inside_the_gap()
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

    def moved(mesh: TriangleMesh) -> TriangleMesh:
        return mesh.with_vertices(100.0 * mesh.vertices @ turn.T + np.array([3.0, 5.0, -7.0]))

    expected = find_bridges(cloth, torn(cloth), *body)
    found = find_bridges(moved(cloth), moved(torn(cloth)), *map(moved, body))
    np.testing.assert_array_equal(found, expected)


def test_cloth_that_is_not_torn_stays(body):
    cloth = inside_the_gap()
    assert not find_bridges(cloth, cloth, *body).any()


def test_loose_cloth_between_two_limbs_stays(body):
    """A skirt or a wide sleeve: it hangs from trunk to arm in front of both, and its weights change slowly."""
    x = np.linspace(0.0, AXIS, 80)
    front = sheet(np.stack([x, np.full(80, TRUNK + 0.01)], axis=1))
    assert not find_bridges(front, torn(front, width=AXIS), *body).any()
    # Not even where the weights jump: it is flat, while a bridge is the bottom of a fold.
    assert not find_bridges(front, torn(front), *body).any()


def test_flat_cloth_that_leaves_one_limb_and_arrives_at_another_is_torn(body):
    """A coarse scan fuses sleeve and side in front of the gap without a fold; its weights jump between two columns."""
    x = np.linspace(0.0, AXIS, 80)
    front = sheet(np.stack([x, np.full(80, TRUNK + 0.01)], axis=1))
    tears = find_tears(front, torn(front), *body)
    columns = front.triangles[tears][:, :, 0]
    middle = TRUNK + GAP / 2
    assert tears.any() and (columns.min(axis=1) < middle).all() and (columns.max(axis=1) > middle).all()
    # Weights that change slowly stretch it 2.4 times, which is no tear.
    assert not find_tears(front, torn(front, width=AXIS), *body).any()
    assert not find_tears(front, torn(front), *body, config=BridgeConfig(tear=1000.0)).any()


def test_tiny_edges_that_noise_stretches_are_no_tears(body):
    cloth = inside_the_gap()
    noise = np.zeros(cloth.vertices.shape)
    noise[::7, 1] = 1e-3
    fine = cloth.with_vertices(0.02 * cloth.vertices)
    assert not find_tears(fine, fine.with_vertices(fine.vertices + noise), *body).any()


def test_a_cape_over_the_shoulder_stays(body):
    """It goes round trunk and arm from outside."""
    angle = np.linspace(1.5, -1.5, 120)
    cape = sheet(np.stack([0.05 + 0.3 * np.cos(angle), 0.2 * np.sin(angle)], axis=1))
    assert not find_bridges(cape, torn(cape), *body).any()


def test_cloth_that_follows_one_limb_through_the_gap_stays(body):
    """A tight shirt without sleeves, 5 mm off the trunk."""
    off = 0.005
    trunk = np.linspace(1.2, -1.2, 160)
    along = (TRUNK + off) * np.stack([np.cos(trunk), np.sin(trunk)], axis=1)
    cloth = sheet(along)
    assert not find_bridges(cloth, torn(cloth, width=1.0), *body).any()


def test_a_cut_leaves_manifold_openings_and_names_its_vertices(body):
    cloth = inside_the_gap()
    bridge = find_bridges(cloth, torn(cloth), *body)
    left, source = cut_bridges(cloth, bridge)
    assert left.face_count == int((~bridge).sum())
    np.testing.assert_array_equal(left.vertices, cloth.vertices[source])
    assert edge_groups(left.faces)[2].max() == 2
    assert len(border_loops(cloth.faces)) == 1 and len(border_loops(left.faces)) == 2


@pytest.mark.parametrize("mirrored", [False, True])
def test_cuts_that_meet_in_a_vertex_are_one(mirrored):
    """Two squares that touch in a corner: no vertex becomes two, and no more goes than the faces of one side there."""
    plane = sheet(np.stack([np.linspace(0, 0.4, 41), np.zeros(41)], axis=1))
    x, y = plane.face_centers[:, 0], plane.face_centers[:, 1]
    low, high = y.min(), y.max()
    middle = 0.01 * round(50 * (low + high))
    y = low + high - y if mirrored else y
    bridge = np.zeros(plane.face_count, dtype=bool)
    for left_x, top in ((0.15, middle), (0.20, middle + 0.05)):
        bridge |= (x > left_x) & (x < left_x + 0.05) & (y > top - 0.05) & (y < top)
    left, source = cut_bridges(plane, bridge)
    assert len(np.unique(source)) == len(source)
    assert 0 < (~bridge).sum() - left.face_count <= 5
    assert len(border_loops(plane.faces)) == 1 and len(border_loops(left.faces)) == 2
    np.testing.assert_array_equal(left.vertices, plane.vertices[source])


def test_specks_that_a_cut_leaves_go_with_it():
    plane = sheet(np.stack([np.linspace(0, 0.4, 41), np.zeros(41)], axis=1))
    ring = np.abs(np.linalg.norm(plane.face_centers - [0.2, 0.2, 0.0], axis=1) - 0.03) < 0.012
    assert len(border_loops(plane.submesh(~ring)[0].faces)) == 3
    left, _ = cut_bridges(plane, ring, config=BridgeConfig(speck_area=0.05))
    assert len(border_loops(left.faces)) == 2


@pytest.mark.parametrize(
    "change", [{"jump": 0.5}, {"stretch": 0.0}, {"tear": 0.5}, {"speck_area": -1.0}, {"rounds": -1}]
)
def test_settings_without_meaning_are_refused(change):
    with pytest.raises(InputError, match=f"bridges: {next(iter(change))}"):
        BridgeConfig(**change)
