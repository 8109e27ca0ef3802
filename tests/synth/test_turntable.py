"""The motion of a person who turns on the spot."""

from __future__ import annotations

import numpy as np

from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.core import matrix_from_rotvec
from smplxpp.synth.motion import Turntable, relaxed_pose


def test_one_turn_with_limbs_that_are_not_held_still():
    motion = Turntable(np.zeros(20), ("jawOpen",), seconds=8.0, seed=3)
    params = motion.at(np.linspace(0.0, 8.0, 25))
    np.testing.assert_allclose(params.full_pose[0], relaxed_pose(), atol=1e-12)
    # The pelvis looks 345 degrees further to the left, in equal steps, and never leans by more than 5 degrees.
    roots = matrix_from_rotvec(params.full_pose[:, 0])
    turned = np.degrees(np.unwrap(np.arctan2(roots[:, 0, 2], roots[:, 2, 2])))
    assert abs(turned[-1] - turned[0] - 345.0) < 6.0 and np.ptp(np.diff(turned)) < 8.0
    assert np.degrees(np.arccos(roots[:, 1, 1])).max() < 5.0
    # Arms sway by degrees, the feet stay on their spot but for centimetres.
    arm = np.degrees(params.full_pose[:, SMPLX_JOINTS.index("left_shoulder")].std(axis=0))
    assert 1.0 < arm.max() < 12.0
    assert 0.01 < np.ptp(params.transl[:, 0]) < 0.2 and np.ptp(params.transl[:, 1]) == 0.0
