"""Lips part where a jaw opens: no vertex of the upper one hangs on the jaw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from smplxpp.assemble.body_inside import part_lips
from smplxpp.body import BodyModel, load_body
from smplxpp.core import BodyParams

BODY = load_body()


def stretch(body: BodyModel) -> np.ndarray:
    """Metres by which edges grow when the jaw hangs by 0.3 radians."""
    rest = BodyParams.rest(betas=0, expressions=body.num_expressions)
    opened = replace(rest, jaw_pose=np.array([[0.3, 0.0, 0.0]]))
    edges = np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]]])
    before, after = (
        np.linalg.norm(np.diff(body.forward(one).vertices[0][edges], axis=1)[:, 0], axis=1) for one in (rest, opened)
    )
    return after - before


def test_no_fangs_hang_from_the_upper_lip_of_an_open_mouth():
    """The open body's rig gave vertices of the closed upper lip to the jaw, which drew them across the mouth."""
    parted = part_lips(BODY)
    assert stretch(BODY).max() > 0.015 and stretch(parted).max() < 0.005
    changed = (parted.weights != BODY.weights).any(axis=1)
    assert 0 < changed.sum() < 30, "nothing but the leak changes"
    np.testing.assert_allclose(parted.weights.sum(axis=1), 1.0, atol=1e-12)
    assert (parted.weights >= 0.0).all()
    # A second time there is nothing left to part.
    assert part_lips(parted) is parted


def test_a_body_without_a_jaw_stays():
    other = replace(BODY, joint_names=tuple("chin" if name == "jaw" else name for name in BODY.joint_names))
    assert part_lips(other) is other
