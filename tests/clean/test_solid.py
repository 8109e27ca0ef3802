"""Sheets with a thickness, and body and clothes as one closed piece, held against trimesh."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import trimesh

from smplxpp.clean.solid import SolidConfig, separate_touching_vertices, solid_of_parts, thickened, wall_thickness
from smplxpp.clean.thicken import slab_behind
from smplxpp.core import GeometryWarning, InputError, TriangleMesh, concatenate_meshes
from smplxpp.core.solids import closed_mesh, mesh_of_solid, solid_of_mesh
from smplxpp.metrics import self_intersections

RADIUS = 0.25


def ball(radius: float = RADIUS, at: tuple[float, float, float] = (0, 0, 0)) -> TriangleMesh:
    made = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return TriangleMesh(made.vertices + at, made.faces)


def bowl(radius: float, cut: float, at: tuple[float, float, float] = (0, 0, 0)) -> TriangleMesh:
    """The part of a ball above `cut`, open below."""
    whole = ball(radius)
    sheet = whole.submesh(whole.face_centers[:, 1] > cut)[0]
    return sheet.with_vertices(sheet.vertices + at)


def independent(mesh: TriangleMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def cap_volume(radius: float, cut: float) -> float:
    height = radius - cut
    return np.pi * height**2 * (3 * radius - height) / 3


def quiet(body: TriangleMesh, parts: dict[str, TriangleMesh], **options: float):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        return solid_of_parts(body, parts, config=SolidConfig(cells=120, **options))


@pytest.mark.parametrize("made_by", ["offset", "level set"])
@pytest.mark.long
def test_a_bowl_of_a_thickness_has_the_volume_of_a_shell(made_by: str):
    sheet, depth = bowl(RADIUS, 0.0), 0.02
    if made_by == "offset":
        shell = thickened(sheet, inward=depth)
    else:
        shell = slab_behind(sheet, np.full(sheet.vertex_count, depth), cell=0.006)
    other = independent(shell)
    assert other.is_watertight and other.is_winding_consistent and other.body_count == 1
    expected = 2 / 3 * np.pi * (RADIUS**3 - (RADIUS - depth) ** 3)
    # The rim of a level set is round: half a disc of the thickness, all around.
    rim = np.pi * (depth / 2) ** 2 / 2 * 2 * np.pi * (RADIUS - depth / 2) if made_by == "level set" else 0.0
    assert other.volume == pytest.approx(expected + rim, rel=0.03)
    assert not len(self_intersections(shell))
    assert np.abs(np.linalg.norm(shell.vertices, axis=1) - RADIUS + depth / 2).max() < depth / 2 + 0.002


def test_cloth_thicker_than_its_folds_cuts_itself_as_an_offset_and_not_as_a_level_set():
    x, z = np.meshgrid(np.linspace(0, 0.4, 60), np.linspace(0, 0.2, 20), indexing="ij")
    y = 0.02 * np.sin(2 * np.pi * x / 0.05)
    grid = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    folds = TriangleMesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces)
    assert len(self_intersections(thickened(folds, inward=0.03)))
    slab = slab_behind(folds, np.full(folds.vertex_count, 0.03), cell=0.006)
    assert not len(self_intersections(slab)) and independent(slab).is_watertight


@pytest.mark.parametrize("thickness", [0.001, 0.01])
@pytest.mark.long
def test_a_ball_with_a_hat_is_one_piece_of_the_known_volume(thickness: float):
    gap = 0.004
    hat = bowl(RADIUS + gap, 0.1)
    solid = quiet(ball(), {"hair": hat}, thickness=thickness, gap=0.01)
    other = independent(solid.mesh)
    assert other.is_watertight and other.is_winding_consistent and other.body_count == 1
    assert other.volume * 1e6 == pytest.approx(solid.report.volume_cm3, rel=1e-6)
    # The hat is filled down to the ball: what it adds is the shell between the two.
    added = cap_volume(RADIUS + gap, 0.1) - cap_volume(RADIUS, 0.1)
    plain = independent(ball()).volume
    assert other.volume - plain == pytest.approx(added, rel=0.25)
    assert solid.report.components == 1 and solid.report.genus == 0
    assert solid.report.size_mm[1] == pytest.approx(1e3 * (2 * RADIUS + gap), abs=2.0)


@pytest.mark.long
def test_a_part_farther_than_the_gap_is_joined_and_one_far_away_refused():
    far = bowl(RADIUS + 0.03, 0.15)
    solid = quiet(ball(), {"hair": far}, thickness=0.001, gap=0.01)
    assert solid.report.gap_mm["hair"] == pytest.approx(40.0)
    with pytest.raises(InputError, match=r"part hair.*comes within 80 mm"):
        quiet(ball(), {"hair": bowl(0.1, 0.0, at=(0, 1.0, 0))}, thickness=0.001, gap=0.01)


@pytest.mark.long
def test_walls_are_measured_straight_inward():
    plate = trimesh.creation.box((1.0, 0.02, 1.0)).subdivide().subdivide()
    walls = wall_thickness(TriangleMesh(plate.vertices, plate.faces))
    assert np.median(walls) == pytest.approx(0.02, rel=1e-6)
    two = concatenate_meshes([ball(0.1), ball(0.1, at=(0.05, 0, 0))])  # they cut each other: no wall within
    assert np.percentile(wall_thickness(two), 5) > 0.1


def test_solids_and_meshes_go_back_and_forth_and_open_ones_are_refused():
    whole = ball()
    back = mesh_of_solid(solid_of_mesh(whole))
    assert independent(back).volume == pytest.approx(independent(whole).volume, rel=1e-12)
    with pytest.raises(InputError, match="border edges"):
        solid_of_mesh(bowl(RADIUS, 0.0))
    half = closed_mesh(bowl(RADIUS, 0.0))
    assert independent(half).is_watertight
    assert independent(half).volume == pytest.approx(cap_volume(RADIUS, 0.0), rel=0.1)


def test_bad_options():
    for name in ("thickness", "gap"):
        with pytest.raises(InputError, match=name):
            SolidConfig(**{name: 0.0})


def test_vertices_in_one_place_part_even_where_they_look_the_same_way():
    corner = np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 1]])
    flat = TriangleMesh(np.concatenate([corner, -corner]), np.array([[0, 1, 2], [3, 4, 5]]))
    np.testing.assert_allclose(flat.vertex_normals[0], flat.vertex_normals[3])
    apart = separate_touching_vertices(flat)
    between = np.linalg.norm(apart.vertices[0] - apart.vertices[3])
    assert 1e-5 < between < 1e-4 and len(np.unique(apart.vertices.astype(np.float32), axis=0)) == 6
    np.testing.assert_array_equal(apart.vertices[[1, 2, 4, 5]], flat.vertices[[1, 2, 4, 5]])
