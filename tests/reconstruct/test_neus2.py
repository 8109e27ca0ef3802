import numpy as np
import pytest

from smplxpp.core import InputError, TriangleMesh
from smplxpp.reconstruct import adopt_surface
from smplxpp.reconstruct.hull import zero_surface
from smplxpp.reconstruct.neus2 import UnitCube, mesh_in_world, world_from_space
from tests.reconstruct.scene import BOX, dented_views, inside_dented


@pytest.fixture(scope="module")
def truth():
    return zero_surface(inside_dented, BOX, cell=0.04)


def in_cube(points, cube, *, turned):
    """What a trainer does with the world's points."""
    return (points[:, [1, 2, 0]] if turned else points) * cube.scale + np.array(cube.offset)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("cube", [UnitCube(), UnitCube(0.33), UnitCube(0.8, (0.4, 0.5, 0.7))])
def test_the_cube_is_left_as_it_was_entered(cube, turned):
    points = np.random.default_rng(0).normal(size=(20, 3))
    space = "turned cube" if turned else "cube"
    assert world_from_space(in_cube(points, cube, turned=turned), space, cube) == pytest.approx(points, abs=1e-12)


@pytest.mark.long
def test_the_masks_tell_the_space(truth):
    views = dented_views()
    moved = [camera_shift(view) for view in views]
    shifted = TriangleMesh(truth.vertices + SHIFT, truth.faces)
    for name, vertices in (
        ("world", shifted.vertices),
        ("cube of scale 0.5", in_cube(shifted.vertices, UnitCube(), turned=False)),
        ("turned cube of scale 0.33", in_cube(shifted.vertices, UnitCube(0.33), turned=True)),
    ):
        found, space, shares = mesh_in_world(TriangleMesh(vertices, truth.faces), moved)
        assert space == name
        assert found.vertices == pytest.approx(shifted.vertices, abs=1e-9)
        assert shares[name] > 0.95 and sorted(shares.values())[-2] < 0.9


SHIFT = np.array([0.1, 0.35, -0.2])


def camera_shift(view):
    from dataclasses import replace

    pose = view.camera.cam_from_world.copy()
    pose[:3, 3] -= pose[:3, :3] @ SHIFT
    return replace(view, camera=replace(view.camera, cam_from_world=pose))


def test_a_mesh_of_something_else_is_refused(truth):
    with pytest.raises(InputError, match="silhouettes that fill the masks"):
        mesh_in_world(TriangleMesh(0.2 * truth.vertices + 3.0, truth.faces), dented_views())


def test_an_adopted_surface_stays_and_gets_colours_and_confidence(truth):
    found = adopt_surface(truth, dented_views())
    assert (found.mesh.vertices == truth.vertices).all() and not found.notes
    assert found.confidence[found.seen > 3].mean() > 0.6
    assert found.colors.std() > 10
    opened = TriangleMesh(truth.vertices, truth.faces[50:])
    assert any("no closed manifold" in words for words in adopt_surface(opened, dented_views()).notes)


def test_a_cube_without_a_size_is_refused():
    with pytest.raises(InputError, match="unit cube"):
        UnitCube(0.0)
    with pytest.raises(InputError, match="space of a mesh"):
        world_from_space(np.zeros((1, 3)), "nowhere")
