import numpy as np
import pytest

from smplxpp.core import InputError, TriangleMesh, concatenate_meshes
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.reconstruct.hull import main_body, pixel_footprint, soft_hull, solid_status, zero_surface
from smplxpp.reconstruct.views import Box, Silhouette
from tests.reconstruct.scene import BOX, RADIUS, dented_views, inside_ball, inside_dented


def volume(mesh):
    return np.einsum("ij,ij->", mesh.face_centers, mesh.face_cross) / 6


@pytest.mark.parametrize("cell", [0.05, 0.02, 0.01])
def test_the_zero_surface_of_a_ball_is_the_sphere_closed_and_outward(cell):
    mesh = zero_surface(inside_ball, BOX, cell=cell)
    assert solid_status(mesh) == ("NoError", 0)
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(RADIUS, abs=0.2 * cell**2 / RADIUS + 1e-5)
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=3 * cell**2 / RADIUS**2 + 1e-4)


def test_a_torus_has_genus_one():
    def field(points):
        ring = np.hypot(points[:, 0], points[:, 2]) - 0.35
        return (0.1 - np.hypot(ring, points[:, 1])).astype(np.float32)

    assert solid_status(zero_surface(field, BOX, cell=0.02)) == ("NoError", 1)


@pytest.mark.long
def test_a_field_that_jumps_gives_a_closed_surface():
    """The edge of a view's image cuts the field; cells chosen by its values alone left holes there."""

    def field(points):
        return np.where(points[:, 1] < 0.123, inside_ball(points), np.float32(-5.0)).astype(np.float32)

    mesh = zero_surface(field, BOX, cell=0.01)
    assert not len(mesh.border_edges)
    assert solid_status(mesh) == ("NoError", 0)


def test_a_body_that_sticks_out_of_the_box_is_closed_at_its_sides():
    mesh = zero_surface(inside_ball, Box(np.full(3, -0.6), np.array([0.6, 0.1, 0.6])), cell=0.02)
    assert solid_status(mesh) == ("NoError", 0)
    assert mesh.vertices[:, 1].max() == pytest.approx(0.1, abs=0.01)


def test_noise_gives_a_closed_manifold():
    """Marching cubes has ambiguous cells: none of them may tear the surface."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(64, 64, 64)).astype(np.float32)

    def field(points):
        i, j, k = np.round((points + 1.0) / 0.04).astype(int).T % 64
        return 0.01 * values[i, j, k]

    mesh = zero_surface(field, Box(np.full(3, -0.3), np.full(3, 0.3)), cell=0.04)
    assert solid_status(mesh)[0] == "NoError"


def test_a_field_without_an_inside_is_refused():
    with pytest.raises(InputError, match="a body that lies in all of them"):
        zero_surface(lambda points: np.full(len(points), -1.0, np.float32), BOX, cell=0.05)


def test_the_largest_piece_is_kept_and_another_body_is_named():
    ball = zero_surface(inside_ball, BOX, cell=0.05)
    crumb = TriangleMesh(0.1 * ball.vertices + 2.0, ball.faces)
    kept, said = main_body(concatenate_meshes([crumb, ball]))
    assert kept.vertex_count == ball.vertex_count and not said
    other = TriangleMesh(0.9 * ball.vertices + 2.0, ball.faces)
    kept, said = main_body(concatenate_meshes([other, ball]))
    assert volume(kept) == pytest.approx(volume(ball)) and len(said) == 1


def test_a_hull_holds_the_body_and_no_dent():
    silhouettes = [Silhouette.of(view) for view in dented_views(plain=True)]
    hull = soft_hull(silhouettes, BOX, cell=0.04)
    truth = zero_surface(inside_dented, BOX, cell=0.0125)
    outside = SignedDistanceField(hull, solid=True).query(truth.vertices).distance
    assert outside.max() < 0.007  # a pixel is 9 mm, a cell 40
    assert np.abs(inside_ball(hull.vertices)).mean() < 0.015  # the dent is in no silhouette
    assert np.median(np.abs(inside_ball(hull.vertices))) < 0.008


def test_dissent_makes_the_hull_larger():
    silhouettes = [Silhouette.of(view) for view in dented_views(plain=True)]
    volumes = [volume(soft_hull(silhouettes, BOX, cell=0.03, dissent=k)) for k in (0, 1)]
    assert volumes[1] > 1.01 * volumes[0]


def test_a_pixel_takes_as_many_metres_as_it_is_far():
    silhouettes = [Silhouette.of(view) for view in dented_views(plain=True)]
    camera = silhouettes[0].camera
    expected = np.linalg.norm(camera.position) / camera.K[0, 0]
    assert pixel_footprint(silhouettes, np.zeros(3)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.long
def test_teeth_and_slits_of_a_field_vanish_and_its_surface_stays():
    """Sheets as thin as a cell stood between thighs where the field jumps from one leg's to the other's."""

    def field(points):
        away = np.linalg.norm(points, axis=1)
        teeth = (np.abs(points[:, 0]) < 0.006) & (away < RADIUS + 0.1) & (points[:, 1] % 0.04 < 0.02)
        slit = (np.abs(points[:, 2]) < 0.006) & (away > RADIUS - 0.1)
        return np.where(teeth, 0.006, np.where(slit, -0.006, inside_ball(points))).astype(np.float32)

    rough, smooth = (zero_surface(field, BOX, cell=0.01, smoothing=sigma) for sigma in (0.0, 0.012))
    away = [np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).max() for mesh in (rough, smooth)]
    assert away[0] > 0.09 and away[1] < 0.012
    assert solid_status(smooth) == ("NoError", 0)
