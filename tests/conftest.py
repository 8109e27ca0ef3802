"""Shared fixtures of the tests."""

from __future__ import annotations

import fcntl
import gc
import logging
import os
import signal
from collections.abc import Callable, Generator
from pathlib import Path

import hypothesis
import pytest

from tests import shape_contracts

# A shell starts what runs in the background with interrupts ignored, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

os.environ["TRITON_INTERPRET"] = "1"  # before torch imports Triton, whose kernels then need no GPU

gc.disable()  # until all is collected: nothing that is imported goes away

shape_contracts.install()  # before anything of the packages is imported

from tests import remembered  # noqa: E402 - its imports are of the packages

remembered.install()

# A busy machine is no reason to fail.
hypothesis.settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("any machine")

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"


# Files that take longest come first, because the other worker would wait for one that starts last.
LONGEST = (
    "tests/pipelines/test_build.py",
    "tests/register/locate/test_locate.py",
    "tests/test_examples.py",
    "tests/segment/test_label_worn.py",
    "tests/segment/test_by_body_objects.py",
    "tests/pipelines/test_train_on_cuda.py",
    "tests/build/test_build_template.py",
    "tests/register/test_fit.py",
    "tests/pipelines/test_alone.py",
    "tests/transfer/test_enclosed.py",
    "tests/models/test_model_file.py",
    "tests/reconstruct/test_mask_consensus.py",
    "tests/transfer/test_transfer_confidence.py",
    "tests/training/engine/test_photometric_tasks.py",
    "tests/segment/test_label_by_body.py",
    "tests/people/test_people.py",
    "tests/training/test_train.py",
    "tests/pipelines/stages/test_completeness.py",
    "tests/speech/test_engines.py",
    "tests/training/refinement/test_refine.py",
    "tests/pipelines/report/test_capture_check.py",
    "tests/synth/test_talking.py",
    "tests/fuzz/test_fuzz.py",
    "tests/benchmarks/test_gpu.py",
    "tests/web/test_embed.py",
    "tests/pipelines/test_train.py",
    "tests/reconstruct/test_reconstruct.py",
    "tests/register/locate/test_second_look.py",
    "tests/ablation/test_rows_trained.py",
    "tests/pipelines/test_evaluate.py",
    "tests/reconstruct/test_turntable.py",
    "tests/pipelines/test_evaluate_cloth.py",
    "tests/pipelines/commands/test_register.py",
    "tests/training/test_pretrain.py",
    "tests/native/test_little_memory.py",
)
assert all((ROOT / name).is_file() for name in LONGEST)


# Rooms whose files take a second come last, because a worker holds its next file while it is at the last two tests
# of the one before, for which the other worker waits at the end.
SHORTEST = tuple(ROOT / "tests" / room for room in ("capture", "core", "formats"))
assert all(path.is_dir() for path in SHORTEST)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Let every worker of a test run begin to collect at another room.

    In a new clone each of them would compile every test and rewrite its assertions; so they share the rooms, and read
    what another one has written.
    """
    report = yield
    if collector.path == ROOT / "tests" and isinstance(collector, pytest.Directory):
        worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
        first = worker * len(report.result) // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
        report.result = [*report.result[first:], *report.result[:first]]
    return report


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order files: the longest first, then those of other rooms; `--no-loadscope-reorder` hands them out so."""
    place = {ROOT / name: k for k, name in enumerate(LONGEST)}
    paths = {item.path for item in items}  # once a file: every process orders thousands of tests
    for path in paths - place.keys():
        place[path] = len(LONGEST) + any(room in path.parents for room in SHORTEST)
    # By name among equals, because every worker has collected them in another order.
    rank = {path: k for k, path in enumerate(sorted(paths, key=lambda path: (place[path], path)))}
    items.sort(key=lambda item: rank[item.path])


def pytest_collection_finish() -> None:
    """Spare each test work that grows with what is imported: the collector's rounds, and handlers of logs."""
    # pytest gives each logger that keeps its messages to itself, some forty of torch, a handler three times a test.
    for name, logger in logging.root.manager.loggerDict.items():
        if name.partition(".")[0] == "torch" and isinstance(logger, logging.Logger):
            logger.propagate = True
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def captures() -> Path:
    """The folder of ground-truth captures; tests that need it skip where it is absent."""
    path = SHARED / "captures"
    if not path.is_dir():
        pytest.skip("no ground-truth captures beside the checkout")
    return path


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """Make a folder of a name once for all workers of a test run; nobody may change it.

    The other workers wait for the one that makes it. A folder whose making failed is made again, and fails again.
    """
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def once(name: str, make: Callable[[Path], object]) -> Path:
        with open(base / f"{name}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (base / f"{name}.made").exists():
                make(base / name)
                (base / f"{name}.made").touch()
        return base / name

    return once


@pytest.fixture(scope="session")
def person_run(made_once: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """The embedded person's whole build by the command line, with the smallest texture."""

    def build(run: Path) -> None:
        from pipelines.cli import main

        capture = str(ROOT / "data" / "fixtures" / "person")
        assert main(["build", str(run), "--capture", capture, "--texture-size", "1024", "--json"]) == 0

    return made_once("person", build)


@pytest.fixture(scope="session")
def danced(made_once: Callable[[str, Callable[[Path], object]], Path]) -> tuple[Path, Path]:
    """The capture of the doll that dances, and a run of `smplxpp train` on it with tiny networks."""

    def make(folder: Path) -> None:
        from tests.dolls.dancing import write_dance, write_dance_run
        from tests.pipelines.training_runs import train

        capture, run = write_dance(folder / "dance"), write_dance_run(folder / "run")
        assert train(run, capture) == 0

    folder = made_once("danced", make)
    return folder / "dance", folder / "run"
