"""The examples run from the command line or as it runs them, and what they write is what they say."""

from __future__ import annotations

import ast
import contextlib
import inspect
import io
import json
import os
import re
import runpy
import subprocess
import sys
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import trimesh
from PIL import Image

import avatar
import smplxpp
from avatar.formats.ply import read_splat_ply
from avatar.training.engine.checkpoints import STATE_FILE
from smplxpp import Template, build_template
from smplxpp.build.report import BuildReport
from tests.pipelines.training_runs import quick

ROOT = Path(__file__).resolve().parents[1]
# What each must write into its folder.
FILES = {
    "00_main_job": {"training", "me.avatar", "new_pose.png"},
    "01_build_from_a_scan": {"smplxpp.npz", "template.glb"},
    "02_transfer_weights": {"as_published.ply", "default.ply", "default_for_lower_clothes.ply"},
    "03_metrics": {"comparison.json"},
    "04_animate": {"motion.glb", "squat.ply", "squat.png", "high_step.png", "arms_overhead.png", "twist.png"},
    "06_own_meshes": {"body.ply", "weights.npz", "skirt.obj", "garment_weights.json"},
    "05_fit": {"metrics.jsonl", "splats.ply", "Cam004.png"},
}

SHORT = {"00_main_job": ("--share", "0.005")}
"""Arguments that make an example shorter."""
FACES = {"hair": 400, "shoe": 400, "upper": 1500, "lower": 1500}
GAUSSIANS = 6000
NOTEBOOKS = {"avatar": {"me.avatar", "training"}, "metrics": set(), "template": {"me.glb", "me.npz"}}
"""What each writes beside itself."""
BY_COMMAND = "06_own_meshes"
"""The one that runs in a process of its own; imports of the libraries cost each of those seconds."""


def run_example(name: str, out: Path, *arguments: str, template: Path | None = None) -> str:
    """Run an example from the repository's root; its output.

    Args:
        name: of the example.
        out: folder of its result.
        arguments: of its command line.
        template: what `build_template` gives in the place of the seconds that it takes; None: a build of few faces.
    """
    if name == BY_COMMAND:
        return _in_a_process(name, out, *arguments)
    printed = io.StringIO()
    build = _small_template if template is None else partial(_built_before, template)
    with (
        contextlib.chdir(ROOT),
        contextlib.redirect_stdout(printed),
        mock.patch.object(sys, "argv", [f"{name}.py", *arguments, "--out", str(out)]),
        mock.patch.object(smplxpp, "build_template", build),
        quick(),
        rough_clothes(),
        mock.patch.object(avatar, "TrainConfig", partial(avatar.TrainConfig, gaussians=GAUSSIANS)),
    ):
        runpy.run_path(f"examples/{name}.py", run_name="__main__")
    return printed.getvalue()


@contextlib.contextmanager
def rough_clothes() -> Iterator[None]:
    """Within the block clothes that a two hundredth of the steps has tracked may stretch as they are simulated."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "simulated clothes", smplxpp.core.GeometryWarning)
        yield


def _built_before(template: Path, capture: smplxpp.Capture) -> smplxpp.BuildResult:
    """The result of a build of a capture whose parameters are exact: a template, and the capture as it is."""
    inspect.signature(build_template).bind(capture=capture)
    return smplxpp.BuildResult(Template.load(template), {}, BuildReport({}, {}), capture)


def _small_template(capture: smplxpp.Capture) -> smplxpp.BuildResult:
    """What the main job builds, of fewer faces; garments that coarse warn."""
    config = smplxpp.BuildConfig(budgets=FACES, samples=2000)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", smplxpp.core.GeometryWarning)
        return build_template(capture=capture, config=config)


def _in_a_process(name: str, out: Path, *arguments: str) -> str:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-W", "error", f"examples/{name}.py", *arguments, "--out", str(out)],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def read_notebook(name: str) -> dict:
    """Return a notebook as Jupyter stores it."""
    return json.loads((ROOT / "examples" / "notebooks" / f"{name}.ipynb").read_text())


def code_of_notebook(name: str) -> list[str]:
    """Return the sources of a notebook's code cells."""
    return ["".join(cell["source"]) for cell in read_notebook(name)["cells"] if cell["cell_type"] == "code"]


def test_notebooks_hold_code_alone() -> None:
    """No output of somebody's machine is stored, and every cell has an id, as version 4.5 of the format asks for."""
    assert {path.stem for path in (ROOT / "examples" / "notebooks").iterdir()} == set(NOTEBOOKS)
    for name in NOTEBOOKS:
        book = read_notebook(name)
        assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
        ids = [cell["id"] for cell in book["cells"]]
        assert len(set(ids)) == len(ids) and book["cells"][0]["cell_type"] == "markdown"
        for cell in book["cells"]:
            assert cell.get("outputs", []) == [] and cell.get("execution_count") is None
        for source in code_of_notebook(name):
            ast.parse(source)


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebook_runs_from_top_to_bottom(name: str, tmp_path: Path) -> None:
    printed, names = io.StringIO(), {}
    with (
        contextlib.chdir(tmp_path),
        contextlib.redirect_stdout(printed),
        mock.patch.object(smplxpp, "build_template", _small_template),
        quick(),
        rough_clothes(),
    ):
        for source in code_of_notebook(name):
            exec(compile(source, name, "exec"), names)
    assert {path.name for path in tmp_path.iterdir()} == NOTEBOOKS[name]
    if name == "metrics":
        whole, visible = numbers(r"P2S (\S+) mm of the whole, (\S+) mm of what", printed.getvalue())
        assert visible < whole
    if name == "avatar":
        assert numbers(r"(\S+) dB over the whole", printed.getvalue())[0] > 20.0  # black around her helps


def numbers(pattern: str, text: str) -> list[float]:
    """The numbers that a pattern's groups find, in order."""
    return [float(n) for found in re.findall(pattern, text) for n in (found if isinstance(found, tuple) else (found,))]


def test_every_example_is_listed_and_short() -> None:
    examples = sorted((ROOT / "examples").glob("*.py"))
    assert {path.stem for path in examples} == set(FILES)
    assert all(len(path.read_text().splitlines()) <= 60 for path in examples)
    (main,) = [
        node
        for node in ast.parse((ROOT / "examples" / "00_main_job.py").read_text()).body
        if isinstance(node, ast.FunctionDef)
    ]
    assert main.end_lineno - main.lineno <= 10


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """What the example of the build prints and where it writes: the main job and the fit take its template."""
    out = tmp_path_factory.mktemp("built") / "out"
    return run_example("01_build_from_a_scan", out), out


@pytest.mark.parametrize("name", FILES)
def test_example_runs_and_writes_only_its_files(name: str, tmp_path: Path, built: tuple[str, Path]) -> None:
    text, out = built
    if name != "01_build_from_a_scan":
        out = tmp_path / "out"
        template = built[1] / "smplxpp.npz"
        given = ("--template", str(template)) if name == "05_fit" else SHORT.get(name, ())
        text = run_example(name, out, *given, template=template)
    # A fit on a busy machine leaves the checkpoint of its half minute.
    assert {path.name for path in out.iterdir()} - {STATE_FILE} == FILES[name]
    check = {
        "00": check_main_job,
        "01": check_build,
        "02": check_transfer,
        "03": check_metrics,
        "04": check_animate,
        "05": check_fit,
        "06": check_own_meshes,
    }[name[:2]]
    check(text, out)


def check_build(text: str, out: Path) -> None:
    template = Template.load(out / "smplxpp.npz")
    assert set(template.part_names) == {"body", "hair", "shoe", "upper", "lower"}
    assert numbers(r"(\d+) after", text) == [0]
    assert max(numbers(r"round trip (\S+) m", text)) < 1e-9
    assert set(trimesh.load(out / "template.glb").geometry) >= {"body", "upper"}


def check_transfer(text: str, out: Path) -> None:
    variation = numbers(r"variation (\S+);", text)
    assert len(variation) == 3 and 0 < max(variation) < 0.15
    published, default, labelled = numbers(r"p95 (\S+), edges", text)
    assert max(default, labelled) < published


def check_metrics(text: str, out: Path) -> None:
    whole, visible = numbers(r"P2S (\S+), Chamfer \S+, Hausdorff", text)
    assert visible < whole  # the naked body under the clothes does not count
    scales = dict(re.findall(r"(icon-cm|pytorch3d) +P2S (\S+),", text))
    assert set(scales) == {"icon-cm", "pytorch3d"}
    assert "weights: valid True" in text


def check_animate(text: str, out: Path) -> None:
    assert numbers(r"motion.glb: (\d+) frames at (\S+) a second", text) == [16, 10]
    squat = trimesh.load(out / "squat.ply", process=False)
    standing = 1.5
    assert 0.5 < squat.extents[1] < standing


def check_own_meshes(text: str, out: Path) -> None:
    """A skirt of another program, in centimetres: as good as the same transfer of our own arrays."""
    found, names = smplxpp.SkinWeights.load(out / "garment_weights.json")
    assert "valid True" in text and found.joint_indices.shape[1] == 4 and len(names) == found.joint_count == 55
    topology = np.load(ROOT / "data" / "fixtures" / "person" / "geometry" / "topology.npz")
    layers = smplxpp.TriangleMesh(topology["v_tpose"], topology["faces"])
    skirt, used = layers.submesh(topology["face_part"] == topology["part_names"].tolist().index("lower"))
    assert len(found) == skirt.vertex_count
    assert smplxpp.metrics.total_variation(found, topology["weights"][used]).mean() < 0.1


def check_fit(text: str, out: Path) -> None:
    psnr, ssim = numbers(r"PSNR (\S+) dB, SSIM (\S+)", text)
    assert psnr > 19.0 and ssim > 0.93
    assert len(read_splat_ply(out / "splats.ply")) == 50_000


@pytest.mark.slow
def test_the_main_job_trains_on_what_it_has_built(tmp_path: Path) -> None:
    check_main_job(run_example("00_main_job", tmp_path / "out", "--share", "0.02"), tmp_path / "out")


def check_main_job(text: str, out: Path) -> None:
    count, megabytes = numbers(r"(\d+) Gaussians, (\S+) MB", text)
    assert count == GAUSSIANS and (out / "me.avatar").stat().st_size == pytest.approx(1e6 * megabytes, abs=1e5)
    capture = smplxpp.open_capture(ROOT / "data" / "fixtures" / "person")
    frame, camera = capture.splits.novel_pose_frames[0], capture.splits.novel_view_cameras[0]
    photograph = 255.0 * capture.composited(camera, frame)
    with Image.open(out / "new_pose.png") as image:
        drawn = np.asarray(image, dtype=float)
    person = photograph.max(-1) > 16
    mean_square = np.square(drawn - photograph)[person].mean()
    assert 10 * np.log10(255**2 / mean_square) > 14.0  # a two hundredth of the steps
