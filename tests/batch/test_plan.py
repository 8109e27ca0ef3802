"""What a batch is foretold to take: closed forms, files of rates, factors learned, and what breaks first."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from pipelines.batch.amounts import Facts, TrainingRates, facts_of, recipe_of, training_works
from pipelines.batch.jobs import Job, Needs
from pipelines.batch.plan import (
    Cost,
    Spent,
    breaks_first,
    cost_of,
    demands,
    learned,
    plan_jobs,
    spent_in,
    training_costs,
)
from pipelines.batch.rates import Rates, Site, read_rates
from pipelines.cli import main
from smplxpp.core import InputError
from tests.batch.made import write_manifest
from tests.capture.scene import make_scene
from tests.capture.writers import WRITERS


def test_a_conversion_costs_its_megapixels_and_files():
    facts = Facts(6000, 48, 3.0, 4.0, 4, 600)
    cost = cost_of("convert", facts, Rates(start_s=0.0))
    assert cost.core_hours == pytest.approx(288_000 * 3.0 * 0.154 / 3600)  # 37 core-hours
    assert cost.written_gb == pytest.approx(288_000 * 3.0 * 0.35 / 1e3)  # and with 300 subjects 91 TB
    assert (cost.read_gb, cost.made) == (pytest.approx(1152.0), 576_000)
    # Held-out cameras see all frames; two training cameras see held-out frames and every fourth training frame.
    looks = 4 * 6000 + 2 * 600 + 2 * 5400 / 4
    on_cores = cost_of("evaluate", facts, Rates(start_s=0.0, evaluate_s=0.0))
    assert on_cores.core_hours == pytest.approx(3 * looks * 3.0 * 1.5 / 3600) and on_cores.gpu_hours == 0.0
    assert cost_of("evaluate", facts, Rates(), gpu=True).gpu_hours == pytest.approx(3 * looks * 0.1 / 3600)
    # A template costs a constant and its scan's bytes.
    small, large = (cost_of("build", replace(facts, scan_mb=mb), Rates(start_s=0.0)) for mb in (0.0, 2.0))
    a, b = Rates().build_s
    assert [3600 * cost.core_hours for cost in (small, large)] == pytest.approx([a, a + 2.0 * b])


def test_what_a_site_lacks_is_said_first():
    costs = {"convert": Cost(100.0, 0.0, 500.0, 3000.0, 4e6, 2e6), "train": Cost(4.0, 40.0, 10.0, 0.1, 1e5, 10.0)}
    site = Site(cores=10, gpus=2, disk_tb=10.0, disk_mb_s=1000.0, files_s=1000.0)
    busy = demands(costs.values(), site)
    assert busy == pytest.approx(
        {"cores": 10.4, "GPUs": 20.0, "bytes of the disk": 3510.1 / 3600, "files of the disk": 4100 / 3600}
    )
    assert breaks_first(costs, site) == "GPUs: busy for 20.0 hours, most of all with train"
    assert "3.0 TB are written, 1.0 TB" in breaks_first(costs, Site(gpus=2, disk_tb=1.0))
    assert "inodes" in breaks_first(costs, Site(gpus=2, disk_tb=10.0, files=1e6))
    assert breaks_first(costs, Site(disk_tb=10.0)) == "there is no GPU"
    assert "files of the disk" in breaks_first(costs, Site(cores=100, gpus=99, disk_tb=10.0, files_s=10.0))


def test_rates_of_a_file_replace_ours(tmp_path):
    path = tmp_path / "rates.json"
    given = {"build_s": [99, 1], "train_gpu_hours": {"gpu": 7}, "site": {"gpus": 4, "disk_tb": 2.5}}
    given |= {"training": {"look_s": 2.0, "start_s": {"fit": 1.0}}}
    path.write_text(json.dumps(given))
    rates, site = read_rates(path)
    assert (rates.build_s, rates.register_s, site.gpus, site.disk_tb) == ((99, 1), Rates().register_s, 4, 2.5)
    starts = {**TrainingRates().start_s, "fit": 1.0}
    assert rates.training == replace(TrainingRates(), look_s=2.0, start_s=starts)
    assert rates.train_gpu_hours == {**Rates().train_gpu_hours, "gpu": 7}
    for wrong, words in (
        ({"bild_s": 1}, "bild_s"),
        ({"build_s": [-1, 0]}, "build_s"),
        ({"training": {"loock": 1}}, "loock"),
        ({"training": [1]}, "training"),
        ({"training": {"start_s": 1.0}}, "start_s"),
        ({"training": {"look_s": {"fit": 1.0}}}, "look_s"),
        ({"site": {"gpu": 1}}, "gpu"),
    ):
        path.write_text(json.dumps(wrong))
        with pytest.raises(InputError, match=words):
            read_rates(path)


def test_factors_are_learned_from_what_is_done():
    built = [
        Spent(name, "build", 10.0 * k, 0.0, m) for k, (name, m) in enumerate(zip("abc", (15, 30, 90), strict=True), 1)
    ]
    # Within a range nothing was foretold wrongly; beyond it the nearer end counts.
    cloth = [
        Spent("a", "cloth", 6.0, 4.0, 2.5),
        Spent("b", "cloth", 6.0, 4.0, 9.0),
        Spent("c", "cloth", 6.0, 4.0, 20.0),
    ]
    rates = learned(Rates(factors={"build": 2.0}), [*built, *cloth, Spent("a", "web", 0.0, 0.0, 1.0)])
    assert rates.factors == {"build": 3.0, "cloth": 1.0}
    facts = Facts(1, 1, 0.1, 0.1)
    assert cost_of("build", facts, rates).core_hours == pytest.approx(3.0 * cost_of("build", facts, Rates()).core_hours)
    # A stage's own factor goes before that of the whole training.
    facts, options = Facts(10, 4, 0.1, 0.1), {"preset": "demo"}
    base = training_costs(facts, Rates(), options, gpu=False)
    found = training_costs(facts, Rates(factors={"train": 2.0, "bake": 0.5}), options, gpu=False)
    assert found["bake"].core_hours == pytest.approx(0.5 * base["bake"].core_hours)
    assert found["fit"].core_hours == pytest.approx(2.0 * base["fit"].core_hours)


def test_loose_clothes_cost_a_range_until_they_are_found():
    """A man in trousers was foretold 4.3 times what his search for clothes took, because no part of his was loose."""
    facts, rates = Facts(40, 6, 0.2, 0.1, held_out_frames=8), Rates()
    frames, training = 32, rates.training

    def cloth(facts: Facts, **options) -> tuple[float, float]:
        cost = training_costs(facts, rates, {"preset": "demo", **options}, gpu=False)["cloth"]
        return 3600.0 * (cost.core_hours - cost.unsure_hours), 3600.0 * (cost.core_hours + cost.unsure_hours)

    start = training.start_s["cloth"] + training.start_s_kv["cloth"] * 1e-3 * facts.vertices
    assert cloth(replace(facts, loose=0)) == pytest.approx((start, start))
    looked_at = start + 2 * frames * training.frame_s["cloth"]
    assert cloth(facts) == pytest.approx((looked_at, looked_at + frames * training.simulated_s))
    # A part that is named is simulated without a question.
    least, most = cloth(facts, loose_parts=("lower",))
    assert least == most == pytest.approx(start + frames * (training.frame_s["cloth"] + training.simulated_s))
    assert "cloth" not in training_costs(facts, rates, {"preset": "demo", "cloth": "none"}, gpu=False)
    # What opens a template takes longer for a larger one.
    small, large = (training_costs(replace(facts, vertices=n), rates, {}, gpu=False) for n in (1_000, 40_000))
    assert all(small[stage].core_hours < large[stage].core_hours for stage in small)


def test_a_batch_corrects_its_plan_by_what_its_stages_took(tmp_path):
    _, write, lens = WRITERS["simple"]
    root = write(make_scene(lens=lens, names=("A", "B", "C")), tmp_path / "capture")
    runs, words = tmp_path / "runs", ["train", "RUN", "--capture", str(root), "--preset", "demo", "--json"]
    options = {"preset": "demo"}
    stages = training_costs(facts_of(root), Rates(), options, gpu=False)
    for name in ("anna", "ben"):
        step = {
            "step": "train",
            "command": words,
            "state": "done",
            "attempts": 1 + (name == "ben"),
            "cpu_seconds": 50.0,
        }
        (runs / name).mkdir(parents=True)
        record = {"subject": name, "capture": str(root), "steps": [step], "state": "done", "note": ""}
        (runs / name / "job.json").write_text(json.dumps(record))
        for stage in ("70_fit", "80_teacher", "85_bake", "90_compensate"):
            took = 3 * 3600 * stages[stage[3:]].core_hours
            write_manifest(runs / name / "run", stage, core_seconds=took)
    jobs = [{"subject": name, "capture": str(root), "steps": ["train"]} for name in ("anna", "ben")]
    batch = {"format": "smplxpp batch", "format_version": 1, "name": "b", "version": "1", "code_key": "k", "jobs": jobs}
    (runs / "batch.json").write_text(json.dumps({**batch, "started": "2026-01-31T12:00:00Z", "job_file": "jobs.yaml"}))
    spent = spent_in(runs, Rates())
    # The second subject's training was attempted twice, and says too little.
    assert {one.subject for one in spent} == {"anna"}
    factors = learned(Rates(), spent).factors
    assert {name: factors[name] for name in ("fit", "teacher")} == pytest.approx({"fit": 3.0, "teacher": 3.0})


def test_jobs_are_planned_by_their_captures(tmp_path):
    _, write, lens = WRITERS["simple"]
    root = write(make_scene(lens=lens, names=("A", "B", "C")), tmp_path / "capture")
    facts = facts_of(root)
    assert facts is not None and facts.cameras == 3 and 0.0 < facts.source_mb < 1.0
    assert facts_of("s3://bucket/anna") is None and facts_of(tmp_path / "none") is None
    steps = ("check", "train")
    jobs = [Job("a", str(root), steps, {"train": {"preset": "demo"}}), Job("b", "s3://bucket/b", steps)]
    costs, unknown = plan_jobs(jobs, Rates(start_s=0.0), Site())
    assert unknown == ["b"]  # which counts as the other
    alone = training_costs(facts, Rates(), {"preset": "demo"}, gpu=False)
    assert costs["train"].core_hours == pytest.approx(2 * sum(cost.core_hours for cost in alone.values()))
    on_gpu, _ = plan_jobs(jobs[:1], Rates(), Site(gpus=1))
    assert on_gpu["train"].gpu_hours == pytest.approx(Rates().train_gpu_hours["demo"])
    without, _ = plan_jobs([Job("a", str(root), steps, needs=Needs(gpus=0.0))], Rates(), Site(gpus=1))
    assert without["train"].gpu_hours == 0.0


def test_the_work_of_a_training_follows_from_frames_cameras_pixels_and_options():
    kinds = ("start_s", "start_s_kv", "pose_s", "frame_s")
    nothing = {name: dict.fromkeys(getattr(TrainingRates(), name), 0.0) for name in kinds}
    rates = TrainingRates(look_s=0.0, look_s_mp=1.0, look_s_kg=0.0, simulated_s=0.0, **nothing)
    facts = Facts(50, 7, 0.5, 1.0, held_out_cameras=1, held_out_frames=10, tracked=True)
    options = {"preset": "demo", "teacher_iterations": 250}

    def seconds(changed: Facts = facts, **more) -> dict[str, float]:
        works = training_works(recipe_of({**options, **more}, tracked=changed.tracked), changed, rates)
        return {step: work.takes(rates) for step, work in works.items()}

    one = seconds()
    assert list(one) == ["refine", "fit", "teacher", "bake", "compensate", "cloth"]
    # By hand: passes of three, three, three and four at an eighth, a quarter, a half and the whole size, and two looks
    # without derivatives; six cameras, 50 frames, and the reference frame alone.
    passes = 3 / 64 + 3 / 16 + 3 / 4 + 4 + 0.8
    assert one["refine"] == pytest.approx(0.5 * 6 * (50 * passes + 4 / 64 + 3 / 16 + 3 / 4))
    # 40 tracked frames of 12 + 12 steps, four views each, half of them halved once; 250 steps of three views; an
    # evaluation of a camera and two held-out ones in two frames.
    tracked = 40 * 4 * 12 * (1 + 1 / 4)
    assert one["teacher"] == pytest.approx(0.5 * (tracked + 250 * 3 + 0.4 * (2 + 4)))
    bigger = seconds(replace(facts, megapixels=1.0))
    assert all(bigger[step] == pytest.approx(2 * one[step]) for step in one)
    assert seconds(iterations_share=0.5)["bake"] < 0.6 * one["bake"]
    assert "refine" not in seconds(replace(facts, tracked=False)) and "refine" in seconds(refine_poses="on")
    assert "teacher" not in seconds(no_teacher=True)


@pytest.mark.long
def test_a_training_tells_its_cost_before_it_begins(tmp_path, capsys):
    from tests.dolls.gesturing import doll, write_gestures

    capture, run = write_gestures(tmp_path / "capture"), doll().write_run(tmp_path / "run")
    words = ["train", str(run), "--capture", str(capture), "--preset", "demo", "--device", "cpu", "--dry-run", "--json"]
    assert main([*words, "--refine-poses", "on"]) == 0
    answer = json.loads(capsys.readouterr().out)
    facts = facts_of(capture, run=run)
    alone = training_costs(facts, Rates(), {"preset": "demo", "refine_poses": "on"}, gpu=False)
    assert answer["plan"] == {step: vars(cost) for step, cost in alone.items()} and answer["free_gb"] > 0
    # The tracking is told beside the teacher, whose stage it is a part of.
    assert list(answer["memory_gib"]) == ["refine", "track", "fit", "teacher", "bake", "compensate"]
    assert all(0.0 < one["device"] < 2.0 and one["host"] > 1.0 for one in answer["memory_gib"].values())
    assert main([*words, "--until", "fit"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert list(answer["plan"]) == list(answer["memory_gib"]) == ["fit"]
    assert not (run / "70_fit").exists()
