"""Job files: what they expand to, and what is refused before anything runs."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from pipelines.batch.jobs import Needs, read_jobs
from pipelines.cli import main
from pipelines.commands.batch import check_options
from smplxpp import InputError

GOOD = """
name: spring
out: runs/spring
defaults:
  steps: [convert, check, build, train, evaluate, export]
  build: {texture_size: 1024, no_report: true}
  train: {preset: gpu, loose_parts: [upper, hair]}
  resources: {cores: 4}
  overrides:
    "dancer_*": {train: {preset: paper}, resources: {gpus: 4}}
jobs:
  - {subject: anna, capture: captures/anna, build: {texture_size: 0}}
  - subject: dancer_1
    capture: s3://studio/dancer
    steps: [train, build]
    train: {loose_parts: null, budgets: {hair: 400}}
"""


def job_file(folder: Path, text: str) -> Path:
    path = folder / "jobs.yaml"
    path.write_text(text)
    return path


def test_a_job_is_the_defaults_the_overrides_and_its_own_entries(tmp_path):
    file = read_jobs(job_file(tmp_path, GOOD))
    anna, dancer = file.jobs
    assert (file.name, file.out) == ("spring", tmp_path / "runs/spring")
    assert anna.capture == str(tmp_path / "captures/anna") and dancer.capture == "s3://studio/dancer"
    assert anna.options["build"] == {"texture_size": 0, "no_report": True}
    assert dancer.steps == ("build", "train") and dancer.options["train"]["preset"] == "paper"
    assert (anna.needs, dancer.needs) == (Needs(cores=4), Needs(gpus=4.0))
    # What a step reads is what an earlier one wrote: the converted capture, not the one it was made of.
    folder = Path("/R/anna")
    assert anna.command("convert", folder, "/c") == ["capture", "convert", "/c", "--out", "/R/anna/capture", "--json"]
    assert anna.command("build", folder, "/c")[:4] == ["build", "/R/anna/run", "--capture", "/R/anna/capture"]
    words = dancer.command("train", Path("/R/d"), "/scratch/d")
    assert words == "train /R/d/run --capture /scratch/d --preset paper --budgets hair 400 --json".split()
    check_options(file.jobs[:1])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("out: r\njobs: [{subject: a, capture: c, trian: {}}]", "did you mean 'train'"),
        ("out: r\njob: []", "did you mean 'jobs'"),
        ("out: r\ndefaults: {biuld: {}}\njobs: [{subject: a, capture: c}]", "did you mean 'build'"),
        ("out: r\njobs: [{subject: a, capture: c, resources: {gpu: 1}}]", "did you mean 'gpus'"),
        ("out: r\njobs: [{subject: a, capture: c, steps: [bake]}]", "'bake'"),
        ("out: r\njobs: [{subject: anna, capture: c}, {subject: Anna, capture: d}]", "job 1, anna, writes, too"),
        (
            "out: r\ndefaults: {export: {out: x.glb}}\njobs: [{subject: a, capture: c}, {subject: b, capture: c}]",
            "x.glb",
        ),
        ("out: r\njobs: [{subject: ../a, capture: c}]", "names a folder"),
        ("out: r\njobs: [{subject: Batch.json, capture: c}]", "these names are taken"),
        ('out: r\njobs: [{subject: "", capture: c}]', "names a folder"),
        ("out: r\njobs: [{subject: a}]", "the folder or the address of a capture"),
        ("out: s3://r\njobs: [{subject: a, capture: c}]", "as results"),
        ("jobs: [{subject: a, capture: c}]", "no out"),
        ("out: r\njobs: [{subject: a, capture: c, resources: {gpus: 1.5}}]", "fraction of one"),
        ("out: r\njobs: [{subject: a, capture: c, frames: many}]", "a: frames"),
    ],
)
def test_a_wrong_job_file_is_refused_with_what_was_meant(tmp_path, text, words):
    with pytest.raises(InputError) as caught:
        read_jobs(job_file(tmp_path, text))
    assert words.lower() in str(caught.value).lower()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("train: {presset: gpu}", ("ben: train", "--preset")),
        ("train: {preset: huge}", ("ben: train", "huge")),
        ("build: {seed: x}", ("ben: build", "--seed")),
    ],
)
def test_options_are_parsed_as_their_commands_will_before_anything_runs(tmp_path, capsys, options, words):
    text = f"out: r\njobs: [{{subject: anna, capture: c}}, {{subject: ben, capture: c, {options}}}]"
    assert main(["batch", str(job_file(tmp_path, text)), "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert all(word in error["message"] for word in words), error
    assert not (tmp_path / "r").exists()


def test_a_thousand_subjects_fit_into_a_job_file(tmp_path):
    place = f"s3://studio/{'x' * 250}"
    lines = [f"  - {{subject: s{k:04}, capture: {place}/s{k:04}, train: {{preset: gpu}}}}" for k in range(1000)]
    file = read_jobs(job_file(tmp_path, "\n".join(["out: r", "jobs:", *lines])))
    assert len(file.jobs) == 1000
    check_options(file.jobs)  # once for all that have the same


@pytest.mark.slow
def test_two_commands_run_from_a_job_file_to_the_status(tmp_path):
    """The fixture's files are checked and its template built; half a capture is refused in three sentences."""
    person = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
    text = f"""
out: runs
defaults:
  steps: [check, build]
  check: {{frames: "0"}}
  build: {{no_report: true, texture_size: 0, samples: 1000}}
jobs:
  - {{subject: anna, capture: {person}}}
  - {{subject: ben, capture: half}}
"""
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "cameras.json").write_text("{")
    path = job_file(tmp_path, text)
    command = [sys.executable, "-m", "pipelines.cli"]
    done = subprocess.run(
        [*command, "batch", str(path), "--local", "2", "--json"], stdout=subprocess.PIPE, timeout=3600
    )
    summary = json.loads(done.stdout)
    assert done.returncode == 1 and summary["states"] == {"done": 1, "refused": 1}
    assert (tmp_path / "runs/anna/run/60_assemble/smplxpp.npz").is_file()
    refused = summary["subjects"][0]  # the worst first
    assert refused["step"] == "check" and "expected the files of one layout" in refused["reason"]
    # The stages stand, so that a second start gives the digits of the first without a command.
    again = subprocess.run([*command, "batch", str(path), "--json"], stdout=subprocess.PIPE, timeout=900)
    assert json.loads(again.stdout)["subjects"] == summary["subjects"]
