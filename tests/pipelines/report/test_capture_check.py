"""`smplxpp capture check`: a sound capture passes, every planted fault is found and named."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from PIL import Image

from pipelines.cli import main
from pipelines.commands.capture import FormatName
from pipelines.report.capture_check import write_check_report
from smplxpp.body import load_body
from smplxpp.capture import FORMATS, open_capture
from smplxpp.capture.check import CheckConfig, check_capture
from smplxpp.capture.check.findings import KINDS
from smplxpp.capture.check.views import compare_silhouettes
from smplxpp.core.rotations import matrix_from_rotvec
from tests.capture.scene import make_scene
from tests.capture.writers import write_actorshq, write_avatarrex, write_easymocap, write_neus2, write_simple
from tests.pipelines.report.planted_faults import (
    CALIBRATION_FAULTS,
    FILE_FAULTS,
    PARAMETER_FAULTS,
    changed,
    edit_cameras,
    edit_json,
    edit_params,
    image,
    mask,
    pose,
    swap_folders,
    truncate,
)

DOCS = Path(__file__).resolve().parents[3] / "docs" / "capture_check.md"


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """Our layout: three cameras, four frames in two poses, photographs, two of the cameras and frames held out."""
    root = write_simple(make_scene(), tmp_path_factory.mktemp("captures") / "rig")
    for source in sorted(root.rglob("*00000[01].*")):
        target = source.with_name(source.name.replace("00000", "x").replace("x0", "000002").replace("x1", "000003"))
        shutil.copy(source, target)
    description = {"background": None, "novel_views": ["C"], "novel_pose_frames": [3, 3]}
    (root / "capture.json").write_text(json.dumps(description))
    return root


@pytest.fixture
def rig(sound, tmp_path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "rig"))


def found(root: Path, body, **options) -> dict[str, list[str]]:
    """Messages by kind."""
    out: dict[str, list[str]] = {}
    for finding in check_capture(open_capture(root, **options), body).findings:
        assert finding.remedy
        out.setdefault(finding.kind, []).append(finding.message)
    return out


@pytest.mark.parametrize("lens", [None, "wide"])
def test_a_sound_capture_has_no_complaint(lens, tmp_path, sound, body):
    from tests.capture.scene import LENS

    root = sound if lens is None else write_simple(make_scene(lens=LENS), tmp_path / "rig")
    check = check_capture(open_capture(root), body)
    assert check.findings == () and not check.failed
    assert {view.camera for view in check.views} == set("ABC")
    for fit in check.cameras().values():
        assert fit.outside < 0.01 and fit.iou > 0.97 and fit.verdict == "good"


@pytest.mark.parametrize("write", [write_actorshq, write_avatarrex, write_easymocap])
def test_sound_captures_of_other_layouts_have_no_complaint(write, tmp_path, body):
    scene = make_scene(lens=(0.0,) * 5) if write is write_easymocap else make_scene()
    assert found(write(scene, tmp_path / "set"), body) == {}


@pytest.mark.parametrize("fault", FILE_FAULTS)
def test_faults_of_files_and_masks_are_named(fault, rig, body):
    plant, kind, words = FILE_FAULTS[fault]
    plant(rig)
    messages = found(rig, body)
    assert any(words in message for message in messages.get(kind, [])), messages
    assert not any(k.startswith("calibration") for k in messages)


@pytest.mark.parametrize("fault", PARAMETER_FAULTS)
def test_parameters_out_of_range_are_named(fault, rig, body):
    change, frames, kind, words = PARAMETER_FAULTS[fault]
    edit_params(rig, change, frames)
    messages = found(rig, body)
    assert any(words in message for message in messages.get(kind, [])), messages


def test_one_shape_of_all_frames_is_one_finding(rig, body):
    """Of a turn of 53 frames the report had 53 lines about one shape."""
    edit_params(rig, PARAMETER_FAULTS["betas out of range"][0], range(3))
    assert found(rig, body)["params-betas"] == ["frames 0-2: betas reach 7"]


def test_nan_in_a_frames_file_is_named(rig, body):
    path = rig / "params/000001.npz"
    np.savez(path, **{**np.load(path), "transl": np.full((1, 3), np.nan)})
    assert any("000001.npz" in message for message in found(rig, body)["params-broken"])


@pytest.mark.parametrize("fault", CALIBRATION_FAULTS)
def test_the_usual_mistakes_of_calibrations_are_recognised(fault, rig, body):
    plant, words = CALIBRATION_FAULTS[fault]
    plant(rig)
    messages = found(rig, body)
    # Less than a decimetre off, Rh and Th may pass for a rough fit.
    (message,) = messages.get("calibration") or messages["calibration-loose"]
    assert words in message and "It would fit if" in message, message


def test_swapped_folders_are_recognised(rig, body):
    edit_json(
        rig / "cameras.json",
        lambda content: content["cameras"].extend({**content["cameras"][2], "name": name} for name in ("D", "E")),
    )
    for name in "DE":
        for kind, path in (("rgbs", image), ("masks", mask)):
            (rig / kind / name).mkdir()
            for frame in range(4):
                shutil.copy(rig / path("C", frame), rig / path(name, frame))
    swap_folders(rig)
    messages = found(rig, body)["calibration-camera"]
    assert ["those of camera B" in messages[0], "those of camera A" in messages[1]] == [True, True], messages


def test_one_camera_that_was_moved_is_named_without_a_guess(rig, body):
    turn = matrix_from_rotvec(np.array([0.0, 0.12, 0.05]))
    edit_cameras(rig, lambda arrays: arrays.update(R=turn @ arrays["R"], T=turn @ arrays["T"]), "B")
    (message,) = found(rig, body)["calibration-camera"]
    assert message.startswith("camera B") and "It would fit" not in message


def test_one_frame_with_the_wrong_pose_is_named(rig, body):
    edit_params(rig, changed(transl=lambda t: t + [0.3, 0, 0.2]), [2])
    messages = found(rig, body)
    assert [m.startswith("frame 2: the body does not fit") for m in messages["calibration-frame"]] == [True]
    assert "calibration" not in messages


def test_parameters_of_another_clock_are_recognised(rig, body):
    """Frames alternate between two poses: one frame late is one frame early."""
    for frame in (0, 2):
        a, b = rig / f"params/{frame:06d}.npz", rig / f"params/{frame + 1:06d}.npz"
        first, second = a.read_bytes(), b.read_bytes()
        a.write_bytes(second)
        b.write_bytes(first)
    (message,) = found(rig, body)["calibration"]
    assert "1 frame later" in message or "1 frame earlier" in message


def test_a_noisy_tracker_is_a_warning(rig, body):
    edit_params(rig, changed(transl=lambda t: t + [0.015, 0.01, 0.0]))
    check = check_capture(open_capture(rig), body)
    assert [f.kind for f in check.findings] == ["calibration-loose"] and not check.failed


def test_silhouettes_are_compared_as_sets():
    a, b = np.zeros((100, 100), bool), np.zeros((100, 100), bool)
    a[:40], b[20:60] = True, True
    fit = compare_silhouettes(a, b)
    assert fit.outside == pytest.approx(0.5) and fit.iou == pytest.approx(1 / 3)
    empty = np.zeros_like(a)
    assert compare_silhouettes(empty, empty) is None
    assert compare_silhouettes(empty, b).outside == 1.0 and compare_silhouettes(a, empty).outside == 1.0


def test_frames_are_spread_where_there_are_many(sound, body):
    check = check_capture(open_capture(sound), body, CheckConfig(max_views=6))
    assert check.frames == (0, 3)
    assert check_capture(open_capture(sound), body, CheckConfig(frames=(2,))).frames == (2,)


def test_the_command_answers_in_tables_json_and_files(rig, tmp_path, capsys):
    assert main(["capture", "check", str(rig), "--out", str(tmp_path / "report")]) == 0
    text = capsys.readouterr().out
    assert "no complaint" in text and "3 cameras" in text and "held out: cameras C and frames 3" in text
    html = (tmp_path / "report" / "report.html").read_text()
    assert "Every check passes" in html and "http" not in html.replace("http://www.w3.org", "")
    sheet = np.asarray(Image.open(tmp_path / "report" / "contact_sheet.png"))
    # Outlines of the body, and of the mask where it is another.
    assert (sheet == (255, 60, 140)).all(axis=2).sum() > 500 and (sheet == (0, 210, 255)).all(axis=2).any()
    truncate(rig)
    assert main(["capture", "check", str(rig), "--json", "--frames", "1"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer["failed"] and answer["opened_frames"] == 1
    assert [(f["kind"], f["camera"], f["frame"]) for f in answer["findings"]] == [("file-damaged", "B", 1)]


def test_the_terminal_says_what_to_do(rig, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    pose(lambda R, T: (R.T, -R.T @ T))(rig)
    assert main(["capture", "check", str(rig)]) == 1
    text = capsys.readouterr().out
    assert "R and T are camera to world" in text and "do: invert them" in text and "bad" in text


def test_images_that_a_transform_file_names_in_vain(tmp_path, body):
    root = write_neus2(make_scene(), tmp_path / "scene")
    (root / "images/000001/image_c_002_f_000001.png").unlink()
    assert "image_c_002_f_000001.png" in found(root, body)["image-missing"][0]


@pytest.mark.parametrize("frames", ["x", "0:4:0", "9", "1:2:3:4", ""])
def test_frames_that_are_none_are_refused(frames, sound, capsys):
    assert main(["capture", "check", str(sound), "--frames", frames]) == 2
    assert "--frames" in capsys.readouterr().err


def test_a_report_is_written_without_parameters_and_masks(rig, tmp_path, body):
    shutil.rmtree(rig / "masks")
    shutil.rmtree(rig / "params")
    check = check_capture(open_capture(rig), body)
    write_check_report(check, tmp_path / "out")
    assert {f.kind for f in check.findings} == {"masks-none", "params-none"}
    assert (tmp_path / "out" / "contact_sheet.png").is_file()


def test_every_layout_that_is_read_can_be_named():
    assert set(get_args(FormatName)) == {"auto", *FORMATS}


def test_every_kind_of_finding_is_explained():
    text = DOCS.read_text()
    assert [kind for kind in KINDS if f"`{kind}`" not in text] == []


@pytest.mark.slow
def test_exact_parameters_fit_and_a_trackers_are_doubtful(captures, body):
    root = captures / "woman_casual"
    exact = check_capture(open_capture(root), body, CheckConfig(frames=(0, 30)))
    assert exact.findings == () and max(fit.worst for fit in exact.cameras().values()) < 0.01
    noisy = check_capture(open_capture(root, params=root / "params/params_noisy.npz"), body, CheckConfig(frames=(0,)))
    assert [f.kind for f in noisy.findings] == ["calibration-loose"]
