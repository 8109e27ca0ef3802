"""A person who sways while turning before one camera: silhouettes of different poses carve one surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from smplxpp.body import load_body
from smplxpp.build.turning import posed_person
from smplxpp.core import InputError
from smplxpp.core.topology import face_components
from smplxpp.reconstruct import PhotoView, ReconstructConfig, turntable
from smplxpp.reconstruct.turntable import reconstruct_turntable
from tests.register import turns
from tests.register.turns import turned_person

BODY = load_body()
COARSE = ReconstructConfig(cell=0.016)


@pytest.fixture(autouse=True)
def coarse_first_hull(monkeypatch):
    """The hull that frames are judged by, which leaves out what is ten pixels off, from cells of 2 cm."""
    monkeypatch.setattr(turntable, "_COARSE_M", 0.02)


@pytest.fixture(scope="module")
def turn():
    return turned_person(BODY, 6, sway=8.0, height=160)


@pytest.fixture(scope="module")
def views(turn):
    """Photographs whose red is the share of the height, so that colours tell where they come from."""
    height, width = turn.masks[0].shape
    red = np.broadcast_to(np.linspace(255, 0, height)[:, None], (height, width))
    color = np.stack([red, 0 * red, 0 * red], axis=2).astype(np.uint8)
    return [PhotoView(str(k), turn.camera, color, mask) for k, mask in enumerate(turn.masks)]


def forearms(turn) -> np.ndarray:
    joints = [BODY.joint_names.index(f"{side}_elbow") for side in ("left", "right")]
    near = BODY.weights[:, joints].sum(axis=1) > 0.8
    return np.asarray(BODY.forward(turn.params.frame(0)).vertices[0])[near]


@pytest.mark.long
def test_limbs_that_sway_are_not_cut_off(turn, views):
    person = posed_person(BODY, turn.params)
    found = reconstruct_turntable(views, person, COARSE)
    # Without carrying the limbs, every point of an arm is outside some silhouette: all joints follow the pelvis.
    rigid = replace(person, transforms=np.repeat(person.transforms[:, :1], person.transforms.shape[1], axis=1))
    stiff = reconstruct_turntable(views, rigid, COARSE)
    away = [1e3 * cKDTree(one.mesh.vertices).query(forearms(turn))[0].mean() for one in (found, stiff)]
    assert away[0] < 20.0 and away[1] > 2 * away[0]
    # The trunk and the legs as a whole: within a voxel and a half of the body.
    true = np.asarray(BODY.forward(turn.params.frame(0)).vertices[0])
    assert 1e3 * np.median(cKDTree(true).query(found.mesh.vertices)[0]) < 24.0
    # Colours come from where a vertex is seen.
    top, bottom = found.mesh.vertices[:, 1] > 1.3, found.mesh.vertices[:, 1] < 0.4
    assert found.colors[top, 0].mean() > found.colors[bottom, 0].mean() + 50


@pytest.mark.long
def test_a_frame_of_another_pose_is_left_out_and_named(turn, views):
    person = posed_person(BODY, turn.params)
    moved = views[3]
    wrong = replace(moved, opacity=np.roll(moved.opacity, 30, axis=1))
    found = reconstruct_turntable([*views[:3], wrong, *views[4:]], person, ReconstructConfig(cell=0.03))
    assert list(found.numbers["left_out"]) == ["3"] and "3" not in found.numbers["views"]
    assert any("frame 3 left out" in note for note in found.notes)


def test_masks_of_nobody_are_refused(turn, views):
    empty = [replace(view, opacity=np.zeros_like(view.opacity)) for view in views]
    with pytest.raises(InputError, match="at least 4 with a photograph"):
        reconstruct_turntable(empty, posed_person(BODY, turn.params), COARSE)


@pytest.mark.long
def test_legs_in_trousers_that_touch_stay_two(monkeypatch):
    for side, sign in (("left", -1.0), ("right", 1.0)):
        monkeypatch.setitem(turns.HELD, f"{side}_hip", (0, 0, sign * 2.5))
    close = turned_person(BODY, 6, sway=1.0, height=160)
    # Masks two pixels wider, as of trousers that stand off by 25 mm and close the gap between the legs.
    dressed = [255 * ndimage.binary_dilation(mask > 0, iterations=2).astype(np.uint8) for mask in close.masks]
    color = np.zeros((*dressed[0].shape, 3), np.uint8)
    views = [PhotoView(str(k), close.camera, color, mask) for k, mask in enumerate(dressed)]
    mesh = reconstruct_turntable(views, posed_person(BODY, close.params), COARSE).mesh
    # Cut through the thighs, two fifths of the way from knee to hip: what is below are two pieces of one size.
    joints = BODY.forward(close.params.frame(0)).joints[0]
    knee, hip = (joints[BODY.joint_names.index(f"left_{name}"), 1] for name in ("knee", "hip"))
    low = (mesh.vertices[mesh.faces, 1] < knee + 0.4 * (hip - knee)).all(axis=1)
    sizes = np.sort(np.bincount(face_components(mesh.submesh(low)[0].faces)))[::-1]
    assert len(sizes) >= 2 and sizes[1] > 0.8 * sizes[0]
