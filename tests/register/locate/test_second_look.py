"""A limb that the first search has lost is searched again in the surface that the rest of the body leaves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smplxpp.body import load_body, load_params
from smplxpp.core import ignore_progress
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.locate.search import LocateConfig, Search
from smplxpp.register.locate.second_look import doubtful_limbs, look_again, raise_head

PERSON = Path(__file__).resolve().parents[3] / "data" / "fixtures" / "person"
BODY = load_body()
# Arms of the left side as a first search may leave them, degrees, from the shoulder on.
ACROSS_THE_BELLY = {"left_shoulder": ((0, -30, 0), (0, 0, -65), (50, 0, 0)), "left_elbow": ((0, -105, 0),)}
RAISED = {"left_shoulder": ((0, 0, 60),), "left_elbow": ((0, -10, 0),)}


@pytest.fixture(scope="module")
def search() -> Search:
    mesh = read_mesh(PERSON / "scans" / "scan_000000.ply").mesh
    config = LocateConfig(coarse_points=400, fine_points=1500)
    return Search(Kinematics(BODY), mesh, config, None, ignore_progress)


@pytest.fixture(scope="module")
def truth() -> BodyState:
    return BodyState.of_params(BODY, load_params(PERSON / "params" / "params.npz", body=BODY).frame(0))


def _with(state: BodyState, pose: dict[str, tuple[tuple[float, ...], ...]]) -> BodyState:
    rotations = state.rotations.copy()
    for joint, vectors in pose.items():
        k = list(BODY.joint_names).index(joint)
        rotations[0, k] = np.eye(3)
        for vector in vectors:
            rotations[0, k] = rotations[0, k] @ matrix_from_rotvec(np.radians(np.array(vector, dtype=float)))
    return replace(state, rotations=rotations)


def _off(search: Search, state: BodyState, truth: BodyState, joint: str) -> float:
    k = list(BODY.joint_names).index(joint)
    one, other = (search.kinematics.posture(s, 0).joints[k] for s in (state, truth))
    return float(np.linalg.norm(one - other))


@pytest.mark.long
def test_limbs_that_the_surface_shows_stay_where_they_are(search, truth):
    """Legs are shown and not searched; a wide skirt leaves surface to arms, which prefer their place all the same."""
    found = search.polished("truth", truth, None, steps=1)
    assert set(doubtful_limbs(search, found)) <= {"left arm", "right arm"}
    same, moved = look_again(search, found)
    assert same.cost <= found.cost and moved == ()


@pytest.mark.long
def test_an_arm_that_lies_across_the_belly_is_found_where_it_hangs(search, truth):
    """A woman who walks lost her arm so, although it hangs in the open and costs less there."""
    lost = search.polished("lost", _with(truth, ACROSS_THE_BELLY), None, steps=4)
    assert _off(search, lost.state, truth, "left_wrist") > 0.2
    found, moved = look_again(search, lost)
    assert "left arm" in moved
    assert _off(search, found.state, truth, "left_wrist") < 0.03
    assert found.cost < lost.cost


@pytest.mark.long
def test_a_detector_that_sees_an_arm_elsewhere_makes_it_doubtful_and_the_surface_decides(search, truth):
    """Keypoints of a raised arm propose it; the surface shows it lowered, and there it stays."""
    found = search.polished("truth", truth, None, steps=1)
    raised = search.kinematics.posture(_with(truth, RAISED), 0).joints
    names = list(BODY.joint_names)
    hints = {f"coco_{joint}": raised[names.index(joint)] for joint in ("left_elbow", "left_wrist")}
    assert "left arm" in doubtful_limbs(search, found, hints)
    same, moved = look_again(search, found, hints=hints)
    assert moved == ()
    assert _off(search, same.state, truth, "left_wrist") < 0.02


@pytest.mark.long
def test_a_head_that_started_in_the_collar_is_raised(search, truth):
    """A head bowed into a turned-up collar showed no face, and the collar was labelled skin."""
    low = _with(truth, {"neck": ((28, 0, 0),), "head": ((23, 0, 0),)})
    low = replace(low, transl=low.transl - [0.0, 0.03, 0.0])
    found = search.polished("low", low, None, steps=0)
    raised = raise_head(search, found)
    assert _off(search, low, truth, "jaw") > 0.05 > 0.03 > _off(search, raised.state, truth, "jaw")
    right = search.polished("truth", truth, None, steps=0)
    assert raise_head(search, right) is right
