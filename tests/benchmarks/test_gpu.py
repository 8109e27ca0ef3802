"""What `python -m benchmarks gpu` would do with a GPU, done on the CPU at toy size; and what it does without one."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

import avatar
import benchmarks.gpu.__main__ as gpu
from benchmarks.gpu import parts
from benchmarks.gpu.__main__ import GpuBenchmark, run_part
from benchmarks.gpu.parts import PARTS, Job, enlarge
from smplxpp.capture import open_capture
from tests.dolls.dancing import write_dance, write_dance_run

NETWORK = ("MASTER_ADDR", "MASTER_PORT", "WORLD_SIZE", "RANK", "LOCAL_RANK")


@pytest.fixture(scope="module")
def job(tmp_path_factory) -> Job:
    """Toys: a doll's capture and a run with its template."""
    folder = tmp_path_factory.mktemp("gpu")
    run, capture = write_dance_run(folder / "run"), write_dance(folder / "capture")
    (folder / "work").mkdir()
    return Job(folder / "work", run, capture, 900.0, "cpu")


def found_by(name: str, job: Job) -> dict:
    """What a part notes, run in this process."""
    found: dict = {}
    PARTS[name](job, found.update)
    return found


def test_every_part_has_a_share_of_the_time():
    assert list(gpu.SHARES) == list(PARTS)
    assert set(gpu.NEEDS_TEMPLATE) <= set(PARTS)
    assert set(gpu.LEAST) <= set(PARTS)
    # Parts that others need have what they need, others share what is left.
    left, seconds = list(PARTS), 600.0
    for place, name in enumerate(left):
        own = gpu._seconds(name, left[place:], seconds)
        assert own >= min(gpu.LEAST.get(name, 5.0), seconds)
        seconds -= own
    assert seconds == pytest.approx(0.0, abs=1e-6)
    assert gpu._seconds("nccl", ["nccl"], 42.0) == gpu._seconds("template", ["template", "nccl"], 42.0) == 42.0


@pytest.mark.long
def test_the_demo_is_trained_and_measured(job):
    found = found_by("demo", job)
    assert list(found["stages"]) == ["fit", "teacher", "cloth", "bake", "compensate"]
    assert found["counts"]["novel_view"]["images"] >= 1 and found["views"]["novel_pose"]["psnr"] > 0


@pytest.mark.long
def test_the_preset_of_a_gpu_is_trained_and_measured(job):
    found = found_by("gpu", job)
    for stages in (found["short"]["stages"], found["longer"]["stages"]):
        assert list(stages) == ["fit", "teacher", "bake", "compensate"]
        assert all(stage["steps"] >= 1 and stage["steps_a_second"] > 0 for stage in stages.values())
    assert found["views"]["novel_view"]["psnr"] > 0


@pytest.mark.slow  # the profiles of twelve stages take ten seconds to sum
def test_warm_steps_of_all_stages_are_timed_and_profiled(job):
    found = found_by("steps", job)
    rows, both = found["rows"], ["PretrainField", "Bake", "Compensate"]
    assert (found["width"], found["height"]) == (60, 80)
    stages = [name for name in rows["gpu, plain"] if name != "whole_seconds"]
    assert stages == ["Fit", "Track", "PretrainTeacher", "Teacher", *both]
    assert [name for name in rows["paper, plain"] if name != "whole_seconds"] == ["Fit", "Teacher"]
    assert list(rows["gpu, graphs"])[-2:] == ["Teacher", "whole_seconds"]
    figures = [row for rows_of in rows.values() for row in rows_of.values() if isinstance(row, dict)]
    assert all(one["steps_a_second"] > 0 and one["calls"] > 100 for one in figures)
    assert set(found["foretold_gib"]) == set(rows)


def test_memory_is_foretold_for_every_stage_that_is_timed(job):
    capture = open_capture(job.capture)
    found = {name: parts._foretold(avatar.TrainConfig().recipe(name), capture) for name in ("gpu", "paper")}
    assert list(found["gpu"]) == ["track", "fit", "teacher", "bake", "compensate"]
    assert "track" not in found["paper"] and found["paper"]["teacher"] > found["gpu"]["teacher"] > 0.1


def test_photographs_a_second_are_counted_by_readers(job):
    assert all(rate > 0 for rate in found_by("loader", job)["images_a_second"].values())


def test_the_student_is_the_same_in_half_precision_and_without_checks(job):
    rows = found_by("student", job)["rows"]
    player = rows.pop("player")
    ways = ("graph", "fused graph", "eager")
    assert list(rows) == [f"{numbers}, {way}" for numbers in ("float32", "half") for way in ways]
    assert not any(row["fused"] for row in rows.values())  # toys are the CPU's, which Triton's kernels are not for
    assert player["48x64"]["fps"] > 0
    assert rows["float32, eager"]["difference_mm"] < 1e-3
    assert 0 < rows["half, eager"]["difference_mm"] < 5.0
    assert all(row["48x64"]["fps"] > 0 and not row["recorded"] for row in rows.values())


def test_messages_come_back(job, monkeypatch):
    for name in NETWORK:  # so that what the part sets is taken back
        monkeypatch.setenv(name, "")
    found = found_by("nccl", job)
    assert found["right"] and found["backend"] == "gloo"


def test_enlarged_views_show_the_same_through_their_cameras(job, tmp_path):
    large, capture = open_capture(enlarge(job.capture, tmp_path / "large", (90, 160))), open_capture(job.capture)
    assert large.splits.novel_view_cameras == ("Held0",) and len(large.frames) == 2
    name = large.splits.train_cameras[0]
    assert large.image(name, 0).shape == (160, 90, 3)
    point = np.array([[0.05, 0.5, 0.0]])
    there, here = (it.cameras[name].screen_from_world(point)[0, :2] for it in (large, capture))
    pixels = [
        np.asarray(it.image(name, 0))[tuple(xy.astype(int)[::-1])] for it, xy in ((large, there), (capture, here))
    ]
    np.testing.assert_allclose(*(pixel.astype(float) for pixel in pixels), atol=40)


@pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is there")
def test_without_a_gpu_it_says_what_it_would_run(capsys):
    assert GpuBenchmark(minutes=10.0).run() == 2
    words = capsys.readouterr().out
    assert "no CUDA device" in words and all(name in words for name in PARTS)


def test_a_part_of_another_name_is_refused(capsys):
    assert GpuBenchmark(parts=("everything",)).run() == 2
    assert "no such part: everything" in capsys.readouterr().out


@pytest.mark.long
def test_what_fails_is_stored_and_the_next_part_runs(job, tmp_path, capsys):
    work = tmp_path / "work"
    options = {"capture": job.capture, "run_folder": tmp_path / "none", "work": work, "dry_run": True}
    assert GpuBenchmark(parts=("gpu", "nccl"), minutes=15.0, **options).run() == 1
    written = json.loads((work / "gpu_parts.json").read_text())
    assert written["command"] == "python -m benchmarks gpu --minutes 15 --parts gpu nccl --dry-run"
    stored = written["figures"]
    assert stored["parts"]["gpu"]["state"] == "failed" and "template" in stored["parts"]["gpu"]["error"]
    assert stored["parts"]["nccl"]["state"] == "done" and stored["parts"]["nccl"]["found"]["right"]


@pytest.mark.long
def test_a_part_in_a_process_of_its_own_finds_all_that_it_calls(job, tmp_path):
    """Parts called what their module had not yet defined when it ran as a program; in a test's process it was there."""
    result = run_part("loader", Job(tmp_path, job.run, job.capture, 900.0, "cpu"))
    assert result["state"] == "done", result
    assert set(result["found"]["images_a_second"]) == {"1", "2"}


@pytest.mark.long
def test_a_part_that_crashes_or_takes_too_long_leaves_its_words(job, tmp_path):
    lost = Job(tmp_path, job.run, tmp_path / "no capture", 900.0, "cpu")
    result = run_part("gpu", lost)
    assert result["state"] == "failed" and "no capture" in result["error"] and "Traceback" in result["log"]
    late = run_part("nccl", Job(tmp_path, job.run, job.capture, 0.05, "cpu"))
    assert late["state"] == "stopped" and "longer than" in late["error"]
