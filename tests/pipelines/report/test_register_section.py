"""The report's section on a registration."""

from __future__ import annotations

import io
import shutil

import numpy as np
import pytest
from PIL import Image

from pipelines.report.sections.register import register_section, worst_frames
from pipelines.stages.build_config import RegisterInputs
from pipelines.stages.register_capture import register_capture
from smplxpp.capture import open_capture
from smplxpp.figures.drawings import JOINT, body_on_photograph, draw_bones
from smplxpp.figures.sheets import heat_strip
from tests.pipelines.registrations import FIXTURE, exact, posed_joints, use_keypoints, use_solver


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A registration of two frames, of a capture that has no scans."""
    root, unused = tmp_path_factory.mktemp("made"), shutil.ignore_patterns("geometry", "normals", "scans")
    capture = shutil.copytree(FIXTURE, root / "person", ignore=unused)
    with pytest.MonkeyPatch.context() as patch:
        use_keypoints(patch)
        use_solver(patch, fails=(2,))
        inputs = RegisterInputs(capture, params=capture / "params" / "params_noisy.npz", frames=(0, 2, 5))
        return root, register_capture(root / "run", inputs)


def test_photographs_before_and_after_residuals_confidence_and_problems(made):
    root, record = made
    section = register_section(root / "run", record)
    titles = [picture.caption for picture in section.pictures]
    assert [title.split(":")[0] for title in titles[:3]] == [
        "frame 0, camera Cam001", "frame 0, camera Cam002", "frame 5, camera Cam001",
    ]  # fmt: skip
    assert "largest residual, keypoints to the body 2.0 px" in titles[2] and "confidence" in titles[-1]
    with Image.open(io.BytesIO(section.pictures[0].data)) as picture:
        width, height = picture.size
    assert width > 2 * height * 0.3  # photograph, before and after beside each other
    assert {curve.title for curve in section.curves} == {"keypoints to the body"}
    assert set(section.curves[0].lines) == {"before", "after"}
    cameras, problems = section.tables
    assert len(cameras.rows) == 7 and cameras.rows[0][2] > 0.3 > 1e-6 > cameras.rows[0][3]
    assert problems.rows == (("frame 2: nobody is in the pictures",),)
    assert "1 frames could not be" in section.text[0] and "7 training cameras" in section.text[0]
    assert {check.name for check in section.checks} >= {"keypoints to the body", "share of frames registered"}


def test_figures_remain_when_the_capture_is_gone(made, tmp_path):
    root, record = made
    run = shutil.copytree(root / "run", tmp_path / "run")
    text = (run / "register.json").read_text()
    (run / "register.json").write_text(text.replace(str(root / "person"), str(tmp_path / "gone")))
    section = register_section(run, record)
    assert len(section.pictures) == 1 and section.curves and len(section.tables) == 2


def test_the_worst_frames_are_those_with_the_largest_first_residual():
    content = {
        "frames": [3, 5, 8, 9],
        "residuals": {"after": {"keypoints_px": [None] * 4, "skin_mm": [2.0, None, 9.0, 4.0]}},
    }
    assert worst_frames(content, 2) == [(8, "bare skin to the scan 9.0 mm"), (9, "bare skin to the scan 4.0 mm")]
    assert worst_frames({"frames": [1], "residuals": {"after": {}}}, 2) == []


def test_bones_lie_on_the_person():
    capture = open_capture(FIXTURE)
    camera, mask = capture.cameras["Cam001"], capture.mask("Cam001", 0)
    body, joints = posed_joints()
    black = np.zeros((camera.height, camera.width, 3), np.uint8)
    bones = draw_bones(black, camera, joints[0], body.parents)
    drawn = bones.any(axis=-1)
    assert drawn.sum() > 300 and (mask[drawn] > 127).mean() > 0.97
    left_out = draw_bones(black, camera, joints[0], body.parents, without=range(body.joint_count))
    assert not left_out.any()
    reddest = np.abs(bones.astype(int) - JOINT).sum(axis=-1) < 30
    assert reddest.any()


def test_the_body_over_a_photograph_changes_the_body_alone():
    capture = open_capture(FIXTURE)
    camera, photograph = capture.cameras["Cam001"], capture.image("Cam001", 0)
    body, _ = posed_joints()
    mesh = body.mesh(body.forward(exact().frame(0)).vertices[0])
    over = body_on_photograph(photograph, camera, mesh)
    changed = (over != photograph).any(axis=-1)
    inside = capture.mask("Cam001", 0) > 127
    assert changed[inside].mean() > 0.4 and changed[~inside].mean() < 0.01


def test_a_strip_has_a_cell_for_each_value():
    values = np.array([[0.0, 1.0, np.nan], [1.0, 0.0, 0.5]])
    strip = heat_strip(values, ["knee", "elbow"], [0, 4, 8], limits=(0.0, 1.0))
    same = heat_strip(values, ["knee", "elbow"], [0, 4, 8], limits=(0.0, 1.0))
    np.testing.assert_array_equal(strip, same)
    left = np.argmax((strip[9] != 255).any(axis=-1) & (np.arange(strip.shape[1]) > 60))
    cells = [tuple(strip[9, left + 240 * k + 120]) for k in range(3)]
    assert len(set(cells)) == 3 and cells[2] == (110, 110, 118)  # grey: not known
    assert tuple(strip[27, left + 120]) == cells[1]
