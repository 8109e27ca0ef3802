"""What a batch is foretold to take: closed forms, files of rates, factors learned, and what breaks first."""

from __future__ import annotations

import json

import pytest

from pipelines.batch.jobs import Job, Needs
from pipelines.batch.plan import (
    Cost,
    Facts,
    Rates,
    Site,
    breaks_first,
    cost_of,
    demands,
    facts_of,
    learned,
    plan_jobs,
    read_rates,
)
from smplxpp.core import InputError
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
    on_cores = cost_of("evaluate", facts, Rates(start_s=0.0))
    assert on_cores.core_hours == pytest.approx(3 * looks * 3.0 * 1.5 / 3600) and on_cores.gpu_hours == 0.0
    assert cost_of("evaluate", facts, Rates(), gpu=True).gpu_hours == pytest.approx(3 * looks * 0.1 / 3600)
    with pytest.raises(InputError, match="preset paper"):
        cost_of("train", facts, Rates(), preset="paper")


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
    path.write_text(json.dumps({"build_s": 99, "train_gpu_hours": {"gpu": 7}, "site": {"gpus": 4, "disk_tb": 2.5}}))
    rates, site = read_rates(path)
    assert (rates.build_s, rates.register_s, site.gpus, site.disk_tb) == (99, Rates().register_s, 4, 2.5)
    assert rates.train_gpu_hours == {**Rates().train_gpu_hours, "gpu": 7}
    for wrong, words in (({"bild_s": 1}, "bild_s"), ({"build_s": -1}, "build_s"), ({"site": {"gpu": 1}}, "gpu")):
        path.write_text(json.dumps(wrong))
        with pytest.raises(InputError, match=words):
            read_rates(path)


def test_factors_are_learned_from_what_is_done():
    rates = learned(Rates(factors={"build": 2.0}), {"build": [(10.0, 15.0), (20.0, 30.0), (1.0, 9.0)], "web": []})
    assert rates.factors == {"build": 3.0}
    facts = Facts(1, 1, 0.1, 0.1)
    assert cost_of("build", facts, rates).core_hours == pytest.approx(3.0 * cost_of("build", facts, Rates()).core_hours)


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
    assert costs["train"].core_hours == pytest.approx(2 * Rates().train_core_hours["demo"])
    on_gpu, _ = plan_jobs(jobs[:1], Rates(), Site(gpus=1))
    assert on_gpu["train"].gpu_hours == Rates().train_gpu_hours["demo"]
    without, _ = plan_jobs([Job("a", str(root), steps, needs=Needs(gpus=0.0))], Rates(), Site(gpus=1))
    assert without["train"].gpu_hours == 0.0
