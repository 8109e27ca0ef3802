import warnings
from dataclasses import replace

import numpy as np
import pytest

from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.reconstruct import ReconstructConfig, SweepLevel, reconstruct
from smplxpp.reconstruct.hull import solid_status
from smplxpp.reconstruct.views import silhouette_agreement
from tests.reconstruct.scene import few_views, inside_dented

CONFIG = ReconstructConfig(cell=0.025, levels=(SweepLevel(0.1, 0.01, 0.005, 0.06),))


@pytest.fixture(scope="module")
def found():
    return reconstruct(few_views(), CONFIG)


def test_the_surface_is_nearer_to_the_truth_than_the_hull(found):
    hull, mesh = (np.abs(inside_dented(one.vertices)).mean() for one in (found.hull, found.mesh))
    assert mesh < 0.4 * hull  # 0.59 where the sweep moves it half of the distance, 0.25 where it moves it all
    assert mesh < 0.001
    assert found.numbers["moved_mm"] > 2


def test_it_is_closed_and_fills_its_masks(found):
    assert solid_status(found.mesh) == ("NoError", 0)
    assert found.numbers["genus"] == 0 and found.numbers["status"] == "NoError"
    shares = silhouette_agreement(found.mesh, few_views())
    assert len(shares) == len(few_views()) and min(shares.values()) > 0.96
    assert not found.notes and not found.numbers["left_out"]


@pytest.mark.long
def test_confidence_is_high_where_it_is_right_and_none_where_nobody_looks():
    above = [view for view in few_views() if view.camera.position[1] > 0]
    result = reconstruct(above, CONFIG)
    bottom = result.mesh.vertices[:, 1] < -0.49
    assert bottom.any()
    assert (result.confidence[result.seen < 2] == 0).all()
    assert (result.seen[bottom] < 2).mean() > 0.9
    assert result.unseen > 0.05
    assert result.confidence[result.seen > 3].mean() > 0.6


@pytest.mark.long
def test_the_same_photographs_give_the_same_bits(found):
    again = reconstruct(few_views(), CONFIG)
    assert (again.mesh.vertices == found.mesh.vertices).all() and (again.colors == found.colors).all()


@pytest.mark.long
def test_a_scene_of_another_size_and_place_gives_the_same_surface(found):
    """Twice the size, turned and moved: everything in metres follows."""
    from smplxpp.core.rotations import matrix_from_rotvec

    rotation, shift = matrix_from_rotvec(np.array([0.0, 0.7, 0.0])), np.array([3.0, 0.5, -2.0])
    views = []
    for view in few_views():
        pose = view.camera.cam_from_world.copy()
        pose[:3, :3] = pose[:3, :3] @ rotation.T
        pose[:3, 3] -= pose[:3, :3] @ shift
        views.append(replace(view, camera=replace(view.camera, cam_from_world=pose)))
    moved = reconstruct(views, CONFIG)
    local = (moved.mesh.vertices - shift) @ rotation
    assert np.abs(inside_dented(local)).mean() == pytest.approx(
        np.abs(inside_dented(found.mesh.vertices)).mean(), rel=0.2
    )


@pytest.mark.long
def test_bad_masks_are_left_out_with_a_warning():
    views = list(few_views())
    views[2] = replace(views[2], opacity=255 - views[2].opacity)
    views[7] = replace(views[7], opacity=np.roll(views[7].opacity, 30, axis=1))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = reconstruct(views, replace(CONFIG, refine=False))
    assert set(result.numbers["left_out"]) == {"cam02", "cam07"}
    assert {type(one.message) for one in caught} == {GeometryWarning}
    assert sum("cam07" in words for words in result.notes) == 1
    assert np.abs(inside_dented(result.mesh.vertices)).mean() < 0.02


@pytest.mark.long
def test_without_refinement_it_is_the_hull():
    result = reconstruct(few_views(), replace(CONFIG, refine=False))
    assert (result.mesh.vertices == result.hull.vertices).all()


@pytest.mark.parametrize(
    "wrong", [{"cell": 0.0}, {"cell": float("nan")}, {"dissent": -1}, {"most_views": 1}, {"smoothness": 0.0}]
)
def test_a_configuration_without_sense_is_refused(wrong):
    with pytest.raises(InputError, match="reconstruction config"):
        ReconstructConfig(**wrong)
