"""`smplxpp register` and `smplxpp build --register`: options to inputs, what is printed, when a build registers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from pipelines.cli import main
from pipelines.commands.build import Build
from pipelines.commands.register import Register
from pipelines.stages.build_config import RegisterInputs, load_register, save_register, stages_of
from pipelines.stages.register_capture import observed_digests
from smplxpp.core.errors import InputError
from tests.pipelines.registrations import FIXTURE, use_keypoints, use_solver

TRACKED = FIXTURE / "params" / "params_noisy.npz"
ASKED = ["--capture", str(FIXTURE), "--params", "params_noisy.npz", "--frames", "0,13"]


@pytest.fixture
def solver(monkeypatch):
    use_keypoints(monkeypatch)
    return use_solver(monkeypatch)


@pytest.mark.long
def test_the_command_prints_its_numbers_and_a_table(tmp_path, solver, capsys):
    assert main(["register", str(tmp_path), *ASKED, "--json", "--no-report"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["frames"] == 2 and printed["ran"] and Path(printed["params"]).is_file()
    assert (
        printed["residuals"]["before"]["keypoints_px"] == 8.0 and printed["residuals"]["after"]["keypoints_px"] == 1.5
    )
    assert printed["report"] is None and set(printed["by_camera"]) == set(solver.shown[0].cameras)
    assert main(["register", str(tmp_path), *ASKED, "--no-report"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "keypoints to the body 8.00 px 1.50 px" in shown and "2 frames registered; stands, not run again" in shown
    assert len(solver.shown) == 1


@pytest.mark.long
def test_the_page_stands_alone(tmp_path, solver, capsys):
    assert main(["register", str(tmp_path), *ASKED, "--json"]) == 0
    page = Path(json.loads(capsys.readouterr().out)["report"])
    text = page.read_text()
    for words in (
        "Registration",
        "reference frame",
        "largest residual",
        "confidence of each joint",
        "after, median px",
    ):
        assert words in text
    made = page.stat().st_mtime_ns
    assert main(["register", str(tmp_path), *ASKED, "--json"]) == 0
    assert page.stat().st_mtime_ns == made


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "--capture, or --scan with --params"),
        (["--scan", "nothing.ply"], "option scan"),
        (["--capture", str(FIXTURE), "--frames", "0,99"], "frames that the capture has"),
        (["--capture", str(FIXTURE), "--frames", "x"], "numbers and ranges"),
        (["--capture", str(FIXTURE), "--initial", "none", "--params", str(TRACKED)], "none without --params"),
        (["--capture", str(FIXTURE), "--params", "nowhere.npz"], "does not exist"),
        (["--scan", str(FIXTURE / "scans/scan_000000.ply"), "--params", str(TRACKED), "--frames", "0"], "see --frame"),
    ],
)
def test_bad_options_are_refused_in_words(tmp_path, solver, capsys, options, words):
    assert main(["register", str(tmp_path / "run"), *options, "--json"]) == 2
    assert words in json.loads(capsys.readouterr().out)["error"]["message"]
    assert not solver.shown


@pytest.mark.long
def test_named_landmarks_are_kept_in_the_run(tmp_path, solver, capsys):
    placed, run = tmp_path / "mine.json", tmp_path / "run"
    placed.write_text(json.dumps({"nose": [0.0, 1.5, 0.1]}))
    assert main(["register", str(run), *ASKED, "--landmarks", str(placed), "--no-report"]) == 0
    assert (run / "landmarks.json").read_bytes() == placed.read_bytes()
    assert main(["register", str(run), *ASKED, "--no-report", "--force"]) == 0
    assert [set(shown.landmarks[0]) for shown in solver.shown] == [{"nose"}] * 2
    placed.write_text("[]")
    assert main(["register", str(run), *ASKED, "--landmarks", str(placed), "--json"]) == 2
    assert "an object" in capsys.readouterr().out
    assert b"nose" in (run / "landmarks.json").read_bytes()


# --- builds ---------------------------------------------------------------------------------------------------------


def registration_of(out, **options) -> RegisterInputs | None:
    command = Build(run_folder=out, capture=options.pop("capture", FIXTURE), **options)
    return command.plan().registration


def test_a_build_registers_where_the_capture_says_that_its_parameters_are_tracked(tmp_path):
    assert registration_of(tmp_path) is None  # params.npz: exact
    tracked = registration_of(tmp_path, params=Path("params_noisy.npz"))
    assert tracked == RegisterInputs(capture=FIXTURE, params=TRACKED)
    assert registration_of(tmp_path, params=Path("params_noisy.npz"), register="off") is None
    asked = registration_of(tmp_path, register="on", label_source="scan")
    assert asked.params is None and asked.labels == FIXTURE / "scans" / "scan_000000_labels.npz"


def test_a_build_registers_to_keypoints_where_there_are_no_parameters(tmp_path):
    unused = shutil.ignore_patterns("geometry", "normals", "rgbs", "masks", "params", "keypoints")
    capture = shutil.copytree(FIXTURE, tmp_path / "capture", ignore=unused)
    with pytest.raises(InputError, match=r"params/000000\.npz"):
        registration_of(tmp_path, capture=capture, register="off")
    without = Build(run_folder=tmp_path / "run", capture=capture).plan().inputs
    assert stages_of(without)[:2] == ("03_locate", "05_register")
    (capture / "keypoints").mkdir()
    found = Build(run_folder=tmp_path / "run", capture=capture).plan().inputs
    assert found.params is None and found.motion is None and stages_of(found)[0] == "05_register"
    assert registration_of(tmp_path, capture=capture).start


@pytest.mark.long
def test_a_build_takes_up_what_register_has_made(tmp_path, solver, capsys):
    assert main(["register", str(tmp_path), *ASKED, "--seed", "3", "--json", "--no-report"]) == 0
    options = [str(tmp_path), "--capture", str(FIXTURE), "--until-stage", "10_body", "--json"]
    assert main(["build", *options]) == 0
    assert len(solver.shown) == 1
    assert registration_of(tmp_path).seed == 3
    capsys.readouterr()
    assert main(["build", *options, "--register", "off"]) == 0
    stages = json.loads(capsys.readouterr().out)["stages"]
    assert "05_register" not in stages and "08_capture" in stages
    assert registration_of(tmp_path, params=FIXTURE / "params" / "params.npz") is None


def test_a_scan_is_registered_when_asked(tmp_path):
    scan = FIXTURE / "scans" / "scan_000000.ply"
    options = {"capture": None, "scan": scan, "params": TRACKED, "label_set": "capture"}
    assert registration_of(tmp_path, **options) is None
    found = registration_of(tmp_path, **options, register="on")
    assert (found.scan, found.params, found.capture) == (scan, TRACKED, None)


def test_options_reach_the_inputs(tmp_path):
    command = Register(
        run_folder=tmp_path, capture=FIXTURE, initial="none", frames="0:4:2", hold_out=("Cam001",), frame=2
    )
    inputs = command.inputs()
    assert (inputs.start, inputs.frames, inputs.hold_out, inputs.frame) == (False, (0, 2), ("Cam001",), 2)


def test_keypoints_and_masks_of_other_folders_take_the_place_of_the_captures(tmp_path):
    """What a detector wrote apart from the capture is what the registration sees, and its record says so."""
    from smplxpp.body import load_body
    from smplxpp.build.observe import observe

    apart = shutil.copytree(FIXTURE / "keypoints", tmp_path / "k")
    (apart / "Cam001.npz").unlink()
    options = Register(
        run_folder=tmp_path / "run", capture=FIXTURE, initial="none", keypoints=apart, masks=FIXTURE / "masks"
    )
    inputs = options.inputs()
    assert (inputs.keypoints, inputs.masks) == (apart, FIXTURE / "masks")
    seen = observe(inputs, load_body()).observations
    assert "Cam001" in seen.cameras and "Cam001" not in seen.keypoints and len(seen.keypoints) > 3
    (tmp_path / "run").mkdir()
    save_register(tmp_path / "run", inputs)
    assert load_register(tmp_path / "run") == inputs
    with pytest.raises(InputError, match="option keypoints"):
        Register(run_folder=tmp_path, scan=FIXTURE / "scans/scan_000000.ply", keypoints=apart).inputs()


@pytest.mark.long
def test_a_folder_of_scans_takes_the_place_of_the_captures(tmp_path):
    """Reconstructions of all frames are scans like any others; what is no folder of scans is refused."""
    from smplxpp.body import load_body
    from smplxpp.build.observe import observe

    folder = tmp_path / "02_reconstruct"
    folder.mkdir()
    for frame in (0, 2):
        shutil.copy(FIXTURE / "scans" / "scan_000000.ply", folder / f"scan_{frame:06d}.ply")
    inputs = Register(run_folder=tmp_path / "run", capture=FIXTURE, frames="0:4", scans=folder).inputs()
    body = load_body()
    seen = observe(inputs, body)
    assert set(seen.observations.scans) == {0, 2} and "scan of frame 2" in observed_digests(
        seen, inputs, landmarks=None
    )
    (tmp_path / "run").mkdir()
    save_register(tmp_path / "run", inputs)
    assert load_register(tmp_path / "run") == inputs
    for options, words in (
        ({"capture": FIXTURE, "scan": folder / "scan_000000.ply"}, "--scan beside it"),
        ({"scan": folder / "scan_000000.ply"}, "option scans"),
    ):
        with pytest.raises(InputError, match=words):
            Register(run_folder=tmp_path, scans=folder, **options).inputs()
    with pytest.raises(InputError, match="option scans"):
        observe(Register(run_folder=tmp_path, capture=FIXTURE, frames="0:4", scans=tmp_path / "run").inputs(), body)
