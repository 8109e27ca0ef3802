"""Parameters of a licensed model beside a scan are a start for the open body, and never taken for its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import smplxpp
from smplxpp.body.smpl_params import from_smpl
from smplxpp.build import locate
from smplxpp.build.config import BuildConfig
from smplxpp.build.inputs import plan_build
from smplxpp.build.prepare import given_params, pose_fit, start_params
from smplxpp.build.request import BuildRequest
from smplxpp.core import BodyParams, GeometryWarning, InputError

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
SCAN = FIXTURE / "scans" / "scan_000000.ply"


@pytest.fixture(scope="module")
def body() -> smplxpp.BodyModel:
    return smplxpp.load_body()


@pytest.fixture
def smpl_file(tmp_path) -> Path:
    """Two frames as an estimator of SMPL writes them."""
    pose = np.zeros((2, 72))
    pose[:, 3 * 16 + 2] = -0.8
    np.savez(tmp_path / "fit.npz", pose=pose, shape=np.zeros(10), trans=np.array([[0, 1.2, 0], [0, 1.3, 0.0]]))
    return tmp_path / "fit.npz"


def request(params: Path | BodyParams, body: smplxpp.BodyModel | None = None, **options) -> BuildRequest:
    return BuildRequest(scan=SCAN, params=params, body=body, config=BuildConfig(**options))


def test_a_file_of_smpl_is_a_start_and_not_a_fit(smpl_file, body):
    plan = plan_build(request(smpl_file, frame=1))
    assert plan.inputs.params is None and plan.inputs.start == smpl_file
    assert plan.inputs.steps[:2] == ("locate", "capture") and plan.registration is None
    with pytest.warns(GeometryWarning, match="parameters of SMPL, not of the open body"):
        start = start_params(plan.inputs, body)
    assert len(start) == 1 and start.betas.shape[1] == 0
    # With a model that is not the open body, or by the user's word, they are the fit.
    other = replace(body, left_hand_components=np.eye(45), left_hand_mean=np.zeros(45))
    for given, model, options in ((smpl_file, other, {}), (smpl_file, None, {"whose": "body"})):
        inputs = plan_build(request(given, model, **options)).inputs
        assert inputs.params == given and inputs.start is None and not inputs.locates
        found = given_params(inputs, model or body)
        np.testing.assert_allclose(found.transl, [[0, 1.2, 0]])
    with pytest.raises(InputError, match=r"option register.*--body"):
        plan_build(request(smpl_file, register="off"))
    with pytest.raises(InputError, match="option whose"):
        BuildConfig(whose="mine")
    # Parameters in memory say nothing: the user does.
    rest = BodyParams.rest()
    assert plan_build(request(rest)).inputs.params is rest
    named = plan_build(request(rest, whose="smplx")).inputs
    assert named.start is rest
    np.testing.assert_array_equal(start_params(named, body).transl, from_smpl(rest, "smplx", body).transl)


def test_the_start_proposes_limbs_to_the_search(smpl_file, body, monkeypatch):
    class Asked(Exception):
        pass

    def search(body, mesh, *, colors, labeller, hints):
        raise Asked(hints)

    monkeypatch.setattr(locate, "locate_body", search)
    start = from_smpl(BodyParams.rest(), "smplh", body)
    with pytest.raises(Asked) as asked:
        locate.locate_in_scan(smplxpp.read_scan(SCAN), body, start=start)
    (hints,) = asked.value.args
    index, weights = body.landmarks["coco_left_wrist"]
    place = weights @ body.forward(start).vertices[0][index]
    np.testing.assert_allclose(hints["coco_left_wrist"], place)
    assert {"coco_right_ankle", "nose"} <= hints.keys()


@pytest.mark.long
def test_names_that_tell_nothing_are_told_by_the_scan(body):
    """SMPL-X's names are ours: its parameters stood half a metre too high, and the build failed on 0 % or went on."""
    pose = BodyParams.rest(betas=10)
    theirs = replace(pose, transl=np.array([[0.3, 1.3, 0.0]]))
    scan = body.mesh(body.forward(from_smpl(theirs, "smplx", body)).vertices[0])
    with pytest.raises(InputError, match=r"as SMPL-X's parameters.*--body.*--whose smplx"):
        pose_fit(scan, body, theirs)
    _, output = pose_fit(scan, body, from_smpl(theirs, "smplx", body))
    assert output.checks[0].value > 0.99
    # What stands nowhere is no family's either.
    with pytest.raises(InputError, match="a body that stands in the scan"):
        pose_fit(scan, body, replace(theirs, transl=np.array([[5.0, 0.0, 0.0]])))


def test_a_capture_registers_from_them(smpl_file):
    plan = plan_build(BuildRequest(capture=FIXTURE, params=smpl_file))
    assert plan.registration is not None and plan.registration.params == smpl_file
    with pytest.raises(InputError, match=r"option whose.*--capture"):
        plan_build(BuildRequest(capture=FIXTURE, config=BuildConfig(whose="smplx")))
