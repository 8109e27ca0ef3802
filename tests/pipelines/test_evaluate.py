"""`smplxpp evaluate` on a doll: files, figures, skipping, the report's sections, and what it refuses."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from avatar.evaluation.input_protocol import InputProtocol
from avatar.evaluation.protocol import ProtocolConfig
from avatar.evaluation.report import EvalReport
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.gaussians.tensor_file import save_bound
from avatar.losses import perceptual_weights
from avatar.models.model_file import save_avatar
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from pipelines.cli import main
from pipelines.commands import evaluate as command
from pipelines.report import Report, write_report
from pipelines.report.sections.evaluation import (
    evaluation_figures,
    evaluation_key_numbers,
    evaluation_views,
    standing_evaluation,
)
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import MODEL_FILES
from pipelines.runs.stage import SCHEMA, read_manifest
from pipelines.stages.build_config import BuildConfig, BuildInputs, save_build
from pipelines.stages.evaluate_inputs import input_protocol
from smplxpp.capture import open_capture
from smplxpp.core import BodyParams, InputError
from smplxpp.figures.drawings import read_tiles, surface_picture, write_tiles
from smplxpp.template.template import Template
from tests.dolls.lpips import lpips_weights
from tests.dolls.standing import FRAMES, HELD_OUT, doll, dressed, write_frames
from tests.pipelines.foreign_numbers import sections_of, with_foreign_numbers
from tools.overview import held_out_view
from tools.worst_frames import WorstFrames

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
QUICK = ("--every", "4", "--samples", "1000", "--metric", "none", "--speed-pictures", "1", "--speed-size", "24", "32")


def evaluate(run, capture, *options: str) -> int:
    return main(["evaluate", str(run), "--capture", str(capture), "--device", "cpu", *QUICK, *options, "--json"])


def write_dressed(run: Path) -> Path:
    """A run with nothing but the template of the doll in its dress."""
    (run / "60_assemble").mkdir(parents=True)
    dressed().save(run / "60_assemble" / "smplxpp.npz")
    return run


def write_models(run: Path, template: Template, *, count: int = 600) -> Path:
    """A fit and a student whose field moves the mesh a little, as the training leaves them."""
    torch.manual_seed(0)
    bound = sample_on_mesh(template, SamplingConfig(count=count))
    student = Student(StudentConfig(FieldConfig(width=8, hidden_layers=1)), Rig(template), bound, (0, 1, 2, 3))
    with torch.no_grad():
        for value in student.field.parameters():
            value.add_(0.01 * torch.randn_like(value))
    for name in ("fit", "student"):
        (run / MODEL_FILES[name]).parent.mkdir(parents=True)
    save_bound(bound, run / MODEL_FILES["fit"])
    save_avatar(run / MODEL_FILES["student"], student)
    return run


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("captures") / "doll")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return write_models(write_dressed(tmp_path_factory.mktemp("runs") / "doll"), dressed())


@pytest.fixture(scope="module")
def evaluated(trained, capture, tmp_path_factory):
    run = shutil.copytree(trained, tmp_path_factory.mktemp("evaluated") / "doll")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "log", _Quiet())
        assert evaluate(run, capture) == 0
    return run


def draw_no_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the pictures of surfaces black, which take a fifth of an evaluation, where a test looks at figures."""
    black = np.zeros((2, 2, 3), dtype=np.uint8)
    monkeypatch.setattr("pipelines.stages.evaluate.surface_picture", lambda truth, posed: black)


class _Quiet:
    def warning(self, *_):
        """A run without a build has no report to write."""


def refused(capsys, run, capture, *options: str) -> str:
    """The message of an evaluation that must be refused before anything is written."""
    before = sorted(run.rglob("*"))
    assert evaluate(run, capture, *options) == 2
    message = json.loads(capsys.readouterr().out)["error"]["message"]
    assert sorted(run.rglob("*")) == before
    return message


def test_files_of_the_stage(evaluated):
    folder = evaluated / "95_evaluate"
    report = EvalReport.load(folder / "metrics.json")
    assert list(report.models) == ["fit", "student"]
    assert report.models["student"].bytes == (evaluated / MODEL_FILES["student"]).stat().st_size
    for name in ("summary", "training", "novel_view", "novel_pose", "novel_pose_training_view", "surface", "cost"):
        for ending in ("txt", "csv", "tex"):
            assert (folder / "tables" / f"{name}.{ending}").stat().st_size > 0
    manifest = read_manifest(folder)
    shown = {Path(view["file"]).name for view in manifest["numbers"]["views"]}
    assert {"novel_view_Held0_000000.png", "novel_pose_Held1_000004.png"} <= shown
    assert {path.name for path in (folder / "pictures").iterdir()} == shown | {
        "surface_training_000001.png",
        "surface_held_out_000005.png",
    }
    truth, rendered = read_tiles(folder / "pictures" / "novel_view_Held0_000000.png", 2)
    np.testing.assert_array_equal(truth, doll().images["Held0"])
    assert not np.array_equal(rendered[0], rendered[1])
    names = [check["name"] for check in manifest["checks"]]
    assert "student, novel views: PSNR of the person" in names and "template's silhouette on the masks" in names
    assert "P2S of lower against skinning alone, training frames" in names


def test_the_worst_views_make_one_picture(evaluated, trained, tmp_path):
    out = tmp_path / "worst.jpg"
    WorstFrames(evaluated, out).run()
    with Image.open(out) as image:
        whole = image.size
    WorstFrames(evaluated, out, models=("student",)).run()
    with Image.open(out) as image:
        one = image.size
    assert one[0] < whole[0] and one[1] == whole[1]  # a column less, as many rows
    with pytest.raises(InputError, match="worst views"):
        WorstFrames(trained, out).run()


def test_an_evaluation_that_stands_is_not_run_again(evaluated, capture, tmp_path, capsys):
    run = shutil.copytree(evaluated, tmp_path / "run")
    assert evaluate(run, capture) == 0
    assert json.loads(capsys.readouterr().out)["ran"] is False
    assert evaluate(run, capture, "--sets", "novel_pose", "--models", "student", "--samples", "0", "--no-report") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["ran"] is True and list(answer["models"]) == ["student"]
    assert list(answer["models"]["student"]["views"]) == ["novel_pose"]


@pytest.mark.long
def test_numbers_of_another_program_are_told_in_the_place_of_the_sections(evaluated):
    record = standing_evaluation(evaluated, sha256_file(evaluated / "60_assemble" / "smplxpp.npz"))
    for make in (evaluation_figures, evaluation_views):
        read, told = sections_of(with_foreign_numbers(record, 60), make, evaluation_key_numbers)
        assert read and told


def test_the_report_shows_figures_and_pictures(evaluated, tmp_path):
    record = standing_evaluation(evaluated, sha256_file(evaluated / "60_assemble" / "smplxpp.npz"))
    figures, pictures = evaluation_figures(record), evaluation_views(record)
    assert [table.caption for table in figures.tables][:2] == [
        "not known: evaluation on doll; parameters not known, labels not known, normals none, "
        "trained on a number of frames that is not known",
        "not known: training views, 2 images, 1 frame of 2 cameras; parameters not known, labels not known, "
        "normals none, trained on a number of frames that is not known",
    ]
    assert any("Perceptual distance: none was measured" in text for text in figures.text)
    assert figures.tables[0].header[1] == "novel views: PSNR" and len(figures.tables[0].rows) == 2
    assert len(figures.pictures) == 2 and "skinning alone" in str(figures.tables[-2].rows)
    captions = [picture.caption for picture in pictures.pictures]
    assert "novel views, Held0, frame 0" in captions
    assert any(caption.startswith("novel poses, Held1, frame 4, head, ") for caption in captions)
    assert len(pictures.comparisons) == 2
    assert [number.label for number in evaluation_key_numbers(record)] == [
        "student, novel views: PSNR of the person",
        "student, novel poses: PSNR of the person",
        "pictures a second",
    ]
    html = write_report(tmp_path / "report.html", Report("doll", sections=(figures, pictures))).read_text()
    assert "Avatar: figures" in html and "http" not in html.replace("http://www.w3.org", "")


def test_the_command_measures_every_held_out_frame_unless_told():
    options, protocol = command.Evaluate(Path("run"), Path("capture")), ProtocolConfig()
    assert options.every == protocol.every == 1 and options.training_every == protocol.training_every


def test_inputs_are_what_capture_build_and_training_say(tmp_path):
    root, run = write_frames(tmp_path / "capture"), tmp_path / "run"
    run.mkdir()

    def known(params: Path | None = None) -> InputProtocol:
        return input_protocol(run, open_capture(root, params=params))

    def say(**said: object) -> None:
        content = json.loads((root / "capture.json").read_text()) | {"inputs": said}
        (root / "capture.json").write_text(json.dumps(content))

    nothing, some = InputProtocol(normals="none"), {"views_with_normals": 0, "training_views": 28}

    def expected(*words: str) -> InputProtocol:
        return InputProtocol(*words, **some)

    assert known() == replace(nothing, **some)
    say(parameters="exact", labels="true", normals="estimated")
    assert known() == expected("exact", "not known", "none")  # labels: nobody says what the run was built from
    (root / "scan.ply").touch()
    (root / "params" / "params_noisy.npz").touch()
    save_build(run, BuildInputs("doll", root / "scan.ply", root / "params" / "000000.npz"), BuildConfig())
    assert known() == expected("exact", "true", "none") and known().name == "exact"
    assert known(root / "params" / "params_noisy.npz").parameters == "not known"
    say(parameters={"params.npz": "exact", "params_noisy.npz": "tracked"}, labels="estimated")
    for path in (Path("params_noisy.npz"), root / "params" / "params_noisy.npz"):
        # A template made with exact parameters, driven by tracked ones, is neither.
        assert known(path) == expected("mixed", "estimated", "none") and known(path).name == "mixed"
    save_build(run, BuildInputs("doll", root / "scan.ply", root / "params" / "params_noisy.npz"), BuildConfig())
    assert known(path) == expected("tracked", "estimated", "none") and known(path).name == "tracked"
    assert known().parameters == "mixed"
    (tmp_path / "params_noisy.npz").touch()
    assert known(tmp_path / "params_noisy.npz").parameters == "not known"
    save_build(run, BuildInputs("doll", tmp_path / "other.ply", root / "params" / "000000.npz"), BuildConfig())
    assert known().labels == "not known"
    (run / "85_bake").mkdir()
    manifest = {"schema": SCHEMA, "numbers": {"training_frames": 4, "training_cameras": 6}}
    (run / "85_bake" / "manifest.json").write_text(json.dumps(manifest))
    assert known().sentence().endswith("trained on 4 frames of 6 cameras")
    say(parameters="good")
    save_build(run, BuildInputs("doll", root / "scan.ply", root / "params" / "000000.npz"), BuildConfig())
    with pytest.raises(InputError, match="'exact' or 'tracked'"):
        known()


def test_the_fixture_says_that_its_inputs_are_exact(tmp_path):
    capture = open_capture(FIXTURE)
    found = input_protocol(tmp_path, capture)
    assert (found.parameters, found.labels, found.normals) == ("exact", "not known", "true")
    assert (found.views_with_normals, found.training_views) == (7, 91)
    assert "normals true (7 of 91 views), trained" in found.sentence()
    noisy = input_protocol(tmp_path, open_capture(FIXTURE, params="params_noisy.npz"))
    assert noisy.parameters == "tracked" and noisy.name == "not known"


def test_an_evaluation_of_other_models_does_not_stand(evaluated, tmp_path):
    run = shutil.copytree(evaluated, tmp_path / "run")
    digest = sha256_file(run / "60_assemble" / "smplxpp.npz")
    assert standing_evaluation(run, digest) is not None and standing_evaluation(run, "other") is None
    with (run / MODEL_FILES["student"]).open("ab") as file:
        file.write(b" ")
    assert standing_evaluation(run, digest) is None
    (run / MODEL_FILES["student"]).unlink()
    assert standing_evaluation(run, digest) is None
    assert standing_evaluation(run.parent, digest) is None


def test_untrained_runs_are_told_to_train(tmp_path, capture, trained, capsys):
    run = write_dressed(tmp_path / "run")
    message = refused(capsys, run, capture)
    assert "a trained teacher or student" in message and "smplxpp train" in message
    (run / "70_fit").mkdir()
    shutil.copy(trained / MODEL_FILES["fit"], run / "70_fit")
    assert "only fit" in refused(capsys, run, capture)
    assert "80_teacher/teacher.safetensors" in refused(capsys, run, capture, "--models", "teacher")


def test_models_of_another_template_and_damaged_ones_are_refused(trained, tmp_path, capture, capsys):
    run = shutil.copytree(trained, tmp_path / "run")
    (run / MODEL_FILES["student"]).write_bytes(b"nonsense")
    assert "student.safetensors" in refused(capsys, run, capture)
    shutil.copy(trained / MODEL_FILES["student"], run / MODEL_FILES["student"])
    anew = replace(dressed(), faces=dressed().faces[:, [1, 2, 0]])
    anew.save(run / "60_assemble" / "smplxpp.npz")
    assert "other faces" in refused(capsys, run, capture, "--models", "student")


def test_captures_that_cannot_be_measured_on(trained, tmp_path, capsys):
    run, root = shutil.copytree(trained, tmp_path / "run"), write_frames(tmp_path / "capture")
    assert "scale" in refused(capsys, run, root, "--scale", "0")
    assert "every" in refused(capsys, run, root, "--every", "0")
    assert "speed-size" in refused(capsys, run, root, "--speed-size", "0", "10")
    assert "Nowhere" in refused(capsys, run, root, "--hold-out", "Nowhere")
    image = root / "rgbs" / "Held0" / "Held0_rgb000000.png"
    kept = image.read_bytes()
    Image.fromarray(np.zeros((10, 10, 3), np.uint8)).save(image)
    assert "Held0" in refused(capsys, run, root)
    image.write_bytes(kept)
    for frame in range(FRAMES):
        away = BodyParams.rest(betas=2, expressions=0)
        BodyParams(**{**away.as_dict(), "transl": np.array([[0.6, 0.0, 0.0]])}).save(
            root / "params" / f"{frame:06d}.npz"
        )
    assert "template in the images" in refused(capsys, run, root)


@pytest.mark.filterwarnings("ignore::smplxpp.core.errors.GeometryWarning")  # that views are left out is what is tested
def test_masks_without_anybody_are_an_error(trained, tmp_path, capsys):
    run, root = shutil.copytree(trained, tmp_path / "run"), write_frames(tmp_path / "capture")
    for name in HELD_OUT:
        for path in [*(root / "masks" / name).iterdir(), *(root / "rgbs" / name).iterdir()]:
            Image.fromarray(np.zeros_like(np.asarray(Image.open(path)))).save(path)
    assert "some for novel views, novel poses" in refused(capsys, run, root)


def test_the_terminal_shows_the_tables(evaluated, capture, capsys):
    arguments = ["evaluate", str(evaluated), "--capture", str(capture), "--device", "cpu", *QUICK, "--no-report"]
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert "not known: evaluation on doll" in out and "skinning alone" in out and "stands, not run again" in out


def test_tiles_keep_every_pixel(tmp_path):
    truth, one, two = np.random.default_rng(0).integers(0, 256, (3, 6, 5, 3)).astype(np.uint8)
    write_tiles(tmp_path / "tiles.png", truth, [one, two])
    read, rendered = read_tiles(tmp_path / "tiles.png", 2)
    assert np.array_equal(read, truth) and np.array_equal(rendered, [one, two])


def test_a_mesh_on_the_truth_is_pale_and_one_off_it_dark():
    mesh = doll().template.mesh
    pale = surface_picture(mesh, {"same": mesh})
    dark = surface_picture(mesh, {"off": mesh.with_vertices(mesh.vertices * 1.2)})
    assert pale.mean() > dark.mean() + 5


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::smplxpp.core.errors.GeometryWarning")  # coarse parts; not what is tested
def test_the_fixture_from_its_build_to_the_page(tmp_path, capsys):
    run = tmp_path / "run"
    budgets = ("--budgets", "upper", "1500", "lower", "1500", "--accept-failures")
    assert main(["build", str(run), "--capture", str(FIXTURE), *budgets, "--json"]) == 0
    write_models(run, Template.load(run / "60_assemble" / "smplxpp.npz"), count=8000)
    capsys.readouterr()
    assert evaluate(run, FIXTURE) == 0
    figures = json.loads(capsys.readouterr().out)
    alone = figures["skinning_alone"]["training"]["mean"]
    assert 1.0 < alone["p2s"] < 12.0 and alone["labels"]["lower"]["p2s"] > alone["labels"]["upper"]["p2s"]
    assert figures["models"]["fit"]["surfaces"]["training"]["mean"] == alone
    fit, student = (figures["models"][name]["mean"]["novel_view"] for name in ("fit", "student"))
    assert fit["psnr"] > 12.0 and fit["psnr"] > student["psnr"]
    html = (run / "report.html").read_text()
    assert "Avatar: figures" in html and "Avatar: side by side" in html


def test_the_overview_shows_the_last_novel_view(evaluated, tmp_path):
    photograph, skinned, student = held_out_view(evaluated)
    assert photograph.shape == skinned.shape == student.shape and photograph.dtype == np.uint8
    views = read_manifest(evaluated / "95_evaluate")["numbers"]["views"]
    shown = [one for one in views if (one["set"], one.get("chosen")) == ("novel_view", "evenly")][-1]
    truth, rendered = read_tiles(evaluated / "95_evaluate" / shown["file"], 2)
    for found, expected in ((photograph, truth), (skinned, rendered[0]), (student, rendered[1])):
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(InputError, match="Run `smplxpp train` and `smplxpp evaluate`"):
        held_out_view(write_dressed(tmp_path / "bare"))


def seeing(run: Path, *, cameras: tuple[str, ...] = (), frames: tuple[int, ...] = ()) -> Path:
    """The run with a record of what its student has seen."""
    manifest = {"schema": SCHEMA, "numbers": {"seen": {"cameras": cameras, "frames": frames}}}
    (run / "90_compensate" / "manifest.json").write_text(json.dumps(manifest))
    return run


def test_views_that_a_model_has_seen_are_not_called_novel(trained, capture, tmp_path, capsys):
    run = shutil.copytree(trained, tmp_path / "run")
    splits = open_capture(capture).splits
    seeing(run, cameras=(*splits.train_cameras, *HELD_OUT), frames=splits.train_frames)
    message = refused(capsys, run, capture)
    assert all(camera in message for camera in HELD_OUT) and "90_compensate" in message
    seeing(run, cameras=splits.train_cameras, frames=splits.train_frames)
    shown = splits.train_frames[-2:]
    message = refused(capsys, run, capture, "--hold-out-frames", *map(str, shown))
    assert all(str(frame) in message for frame in shown) and "frames" in message
    # What was kept from training by hand is what is novel.
    seeing(run, cameras=(*splits.train_cameras[1:], *HELD_OUT), frames=splits.train_frames)
    assert f"--hold-out {splits.train_cameras[0]}" in refused(capsys, run, capture)


@pytest.mark.long
def test_a_model_without_a_record_of_what_it_saw_is_told(trained, capture, tmp_path, caplog):
    run = shutil.copytree(trained, tmp_path / "run")
    with caplog.at_level("WARNING"):
        assert evaluate(run, capture, "--sets", "novel_view") == 0
    assert "90_compensate" in caplog.text and "not recorded" in caplog.text


def test_a_perceptual_distance_that_nobody_asked_for_is_no_warning(monkeypatch, caplog):
    caplog.set_level("INFO")
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    assert command._metric("auto") == "none" and "stlpips-pytorch" in caplog.text
    assert [record.levelname for record in caplog.records] == ["INFO"]
    monkeypatch.setattr(perceptual_weights, "lpips_at_hand", lambda: True)
    assert command._metric("auto") == "lpips"
    monkeypatch.setattr(command, "find_spec", lambda name: object())
    assert command._metric("auto") == "both" and command._metric("lpips") == "lpips"
    monkeypatch.setattr(perceptual_weights, "lpips_at_hand", lambda: False)
    assert command._metric("auto") == "st-lpips"


def test_weights_of_lpips_are_read_before_anything_is_measured(trained, capture, tmp_path, capsys):
    (tmp_path / "mine.pth").write_bytes(b"none")
    options = ("--metric", "auto", "--lpips-weights", str(tmp_path / "mine.pth"))
    assert evaluate(trained, capture, *options) == 2
    assert "mine.pth" in capsys.readouterr().err
    assert evaluate(trained, capture, *options, "--metric", "st-lpips") == 2
    assert "metric auto, both or lpips" in capsys.readouterr().err
    assert not (trained / "95_evaluate_work").exists()


@pytest.mark.long
def test_other_weights_of_lpips_are_measured_with(trained, capture, tmp_path, capsys):
    run, file = shutil.copytree(trained, tmp_path / "run"), tmp_path / "mine.pth"
    options = ("--sets", "novel_view", "--samples", "0", "--metric", "lpips", "--lpips-weights", str(file))
    of_torchvision, own = lpips_weights("alex")
    ran, distances = [], []
    for share in (1.0, 1.0, 2.0):
        torch.save(of_torchvision | {name: share * value for name, value in own.items()}, file)
        capsys.readouterr()
        assert evaluate(run, capture, *options) == 0
        answer = json.loads(capsys.readouterr().out)
        ran.append(answer["ran"])
        distances.append(answer["models"]["student"]["mean"]["novel_view"]["perceptual"])
    assert answer["metric"] == "LPIPS (alex)" and ran == [True, False, True]
    assert distances[1] == distances[0] and distances[2] == pytest.approx(2.0 * distances[0], rel=1e-5)
