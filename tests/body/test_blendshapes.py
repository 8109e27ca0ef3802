"""ARKit's expressions on bodies whose own are numbered; the truth is the embedded body, whose own have names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar.speech import ARTICULATORS, Face, Phoneme, Speech, talking_motion
from avatar.speech.face import MAX_UNOBSERVED_NUMBERED
from smplxpp.body import load_body
from smplxpp.body.blendshapes import ARKIT, FaceSurface, transfer_blendshapes
from smplxpp.body.model import BodyModel
from smplxpp.core import BodyParams, InputError

BODY = load_body()
ROWS = [BODY.expression_names.index(name) for name in ARKIT]
LIPS = [ARKIT.index(name) for name in ("mouthPressLeft", "mouthPressRight", "mouthRollLower", "mouthRollUpper")]


def numbered(directions: np.ndarray, **changes: np.ndarray) -> BodyModel:
    names = tuple(f"expression_{k:02d}" for k in range(directions.shape[2]))
    return replace(BODY, exprdirs=directions, expression_names=names, **changes)


def turned() -> tuple[np.ndarray, np.ndarray]:
    """The named directions mixed by an orthogonal matrix, and the coefficients that undo it."""
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(52, 52)))
    return BODY.exprdirs @ q, q[ROWS]


def principal(count: int) -> np.ndarray:
    """Principal directions of faces drawn at random, scaled to standard deviations, as SMPL-X's are."""
    drawn = np.random.default_rng(1).gamma(0.5, 0.4, size=(400, 52)).clip(0.0, 1.0)
    # Faces are drawn @ directions.T. With directions = q r, their singular vectors are q times those of drawn @ r.T.
    q, r = np.linalg.qr(BODY.exprdirs.reshape(-1, 52))
    _, size, parts = np.linalg.svd((drawn - drawn.mean(axis=0)) @ r.T, full_matrices=False)
    return (q @ (parts[:count] * size[:count, None] / 20.0).T).reshape(-1, 3, count)


def test_arkit_has_the_names_of_the_embedded_body():
    assert sorted(BODY.expression_names) == list(ARKIT) and len(ARKIT) == 52


def test_a_mixture_of_all_directions_is_undone():
    directions, truth = turned()
    body = numbered(directions)
    solved = transfer_blendshapes(body)
    face = FaceSurface.of(body).directions
    off, size = (np.linalg.norm(face @ one.T, axis=(0, 1)) for one in (solved.coefficients - truth, truth))
    visible = size > 1e-3  # the tongue's is not on the face
    assert visible.sum() == 51 and (off < 0.08 * size)[visible].all()
    assert solved.residual[visible].max() < 0.08 and np.abs(solved.gap_error).max() < 1e-4


@pytest.mark.parametrize(("count", "most"), [(10, 0.62), (20, 0.45), (50, 0.06)])
def test_more_principal_directions_leave_less_and_lips_close_all_the_same(count, most):
    solved = transfer_blendshapes(numbered(principal(count)))
    assert solved.residual.mean() < most
    assert np.abs(solved.gap_error[LIPS]).max() < 0.5e-3


def test_another_head_gets_the_same_up_to_its_size():
    directions, truth = turned()
    betas = np.zeros(BODY.shapedirs.shape[2])
    betas[:10] = 1.5 * np.random.default_rng(2).normal(size=10)
    body = numbered(directions, v_template=BODY.v_template + BODY.shapedirs @ betas)
    solved, face = transfer_blendshapes(body), FaceSurface.of(body).directions
    for name in ("mouthPucker", "mouthSmileLeft", "mouthPressLeft", "mouthRollLower", "mouthFunnel", "jawOpen"):
        own, true = (one[ARKIT.index(name)] for one in (solved.coefficients, truth))
        moved, wanted = ((face @ one).ravel() for one in (own, true))
        assert moved @ wanted / np.linalg.norm(moved) / np.linalg.norm(wanted) > 0.99


def test_a_numbered_body_speaks_and_its_lips_meet_for_bilabials():
    body = numbered(principal(20))
    face = Face.of(body.expression_names, body.joint_names, body=body)
    assert face.numbered and face.highest.max() == MAX_UNOBSERVED_NUMBERED
    surface = FaceSurface.of(body)
    pairs = surface.lips
    speech = Speech((Phoneme("AA", 0.1, 0.3), Phoneme("M", 0.3, 0.4), Phoneme("UW", 0.4, 0.7)), 0.9)
    motion = talking_motion(speech, face, BodyParams.rest(betas=0, expressions=20))
    opening = surface.directions[pairs[:, 1], 1] - surface.directions[pairs[:, 0], 1]
    gap = (motion.expression @ opening.T).mean(axis=1)
    named = Face.of(BODY.expression_names, BODY.joint_names)
    true = FaceSurface.of(BODY).directions
    wanted = named.basis @ (true[pairs[:, 1], 1] - true[pairs[:, 0], 1]).mean(axis=0)
    closed = round(0.34 * 30)
    assert abs(gap[closed] - wanted[ARTICULATORS.index("press")]) < 0.6e-3
    assert motion.jaw_pose[closed, 0] < 0.02 < motion.jaw_pose[6, 0]
    assert np.abs(motion.expression).max() <= MAX_UNOBSERVED_NUMBERED
    # Rounded lips are forward.
    lip = motion.expression[[0, 17]] @ surface.directions[pairs[:, 0], 2].mean(axis=0)
    assert lip[1] > lip[0] + 1e-3


def test_a_body_without_a_face_is_refused():
    with pytest.raises(InputError, match="no jaw"):
        FaceSurface.of(replace(BODY, joint_names=tuple("chin" if n == "jaw" else n for n in BODY.joint_names)))
    with pytest.raises(InputError, match="no expressions"):
        FaceSurface.of(replace(BODY, exprdirs=BODY.exprdirs[..., :0], expression_names=()))
    cut = np.array(BODY.v_template)
    cut[BODY.weights[:, BODY.joint_names.index("jaw")] > 0.5, 1] -= 0.05
    with pytest.raises(InputError, match="lips"):
        transfer_blendshapes(numbered(principal(5), v_template=cut))
