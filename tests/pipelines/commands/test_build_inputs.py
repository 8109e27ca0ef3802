"""Which files a build takes, and which stages make what it has not."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.commands.build import Build
from pipelines.runs.layout import LOCATE_STAGE, RECONSTRUCT_STAGE, REGISTER_STAGE, TEMPLATE_STAGES, reconstructed_scan
from pipelines.stages.build_config import (
    BuildConfig,
    ReconstructInputs,
    load_build,
    save_build,
    save_reconstruct,
    stages_of,
)
from smplxpp.core import BodyParams, InputError

PERSON = Path(__file__).resolve().parents[3] / "data" / "fixtures" / "person"


def capture_of(root: Path, *names: str) -> Path:
    """A capture that has only some of the fixture's files."""
    root.mkdir()
    for name in ("cameras.json", "rgbs", "masks", *names):
        (root / name).symlink_to(PERSON / name)
    return root


def stages_before(inputs):
    """The stages of a build that come before those of every build."""
    return tuple(name for name in stages_of(inputs) if name not in TEMPLATE_STAGES)


def test_a_scan_alone(tmp_path):
    asked = Build(run_folder=tmp_path / "run", scan=PERSON / "scans" / "scan_000000.ply")
    inputs = asked.plan().inputs
    assert stages_before(inputs) == (LOCATE_STAGE,) and inputs.params is None and inputs.labels is None
    assert asked.plan().registration is None and asked.plan().reconstruction is None
    assert (asked.plan().config.units, asked.plan().config.up) == ("auto", "auto")


def test_a_scan_with_parameters_says_its_units(tmp_path):
    params = PERSON / "params" / "params.npz"
    asked = Build(run_folder=tmp_path / "run", scan=PERSON / "scans" / "scan_000000.ply", params=params)
    assert stages_before(asked.plan().inputs) == () and (asked.plan().config.units, asked.plan().config.up) == (
        "m",
        "y",
    )
    registered = Build(run_folder=tmp_path / "run", scan=asked.scan, params=params, register="on")
    assert stages_before(registered.plan().inputs) == (REGISTER_STAGE,)
    assert registered.plan().registration.params == params


def test_photographs_alone(tmp_path):
    root = capture_of(tmp_path / "capture")
    asked = Build(run_folder=tmp_path / "run", capture=root, frame=3)
    inputs = asked.plan().inputs
    assert stages_before(inputs) == (RECONSTRUCT_STAGE, LOCATE_STAGE, REGISTER_STAGE)
    assert inputs.scan == tmp_path / "run" / reconstructed_scan(3) and not inputs.label_maps
    reconstruction = asked.plan().reconstruction
    assert reconstruction == ReconstructInputs(root, frames=(3,))
    assert asked.plan().registration.scan == inputs.scan


def test_keypoints_need_no_body_found_in_the_surface(tmp_path):
    root = capture_of(tmp_path / "capture")
    given = Build(run_folder=tmp_path / "run", capture=root, keypoints=PERSON / "keypoints")
    own = Build(run_folder=tmp_path / "run", capture=capture_of(tmp_path / "other", "keypoints"))
    for asked in (given, own):
        assert stages_before(asked.plan().inputs) == (RECONSTRUCT_STAGE, REGISTER_STAGE)
    assert given.plan().registration.keypoints == given.keypoints


def test_a_surface_that_was_reconstructed_stands(tmp_path):
    """What `smplxpp reconstruct --frame all` has made is not made anew for one frame."""
    root, run = capture_of(tmp_path / "capture"), tmp_path / "run"
    asked, all_frames = Build(run_folder=run, capture=root), ReconstructInputs(root, frames=(0, 1, 2))
    (run / reconstructed_scan(0)).parent.mkdir(parents=True)
    save_reconstruct(run, all_frames)
    assert asked.plan().reconstruction.frames == (0,)
    (run / reconstructed_scan(0)).write_bytes(b"ply")
    assert asked.plan().reconstruction.frames == (0, 1, 2)


def test_nobody_has_labelled_it(tmp_path):
    root = capture_of(tmp_path / "capture", "scans", "params")
    by_body = Build(run_folder=tmp_path / "run", capture=root, label_source="body").plan().inputs
    assert by_body.labels is None and by_body.label_source == "body"
    with pytest.raises(InputError, match="label maps of its views"):
        Build(run_folder=tmp_path / "run", capture=root, label_source="views").plan()


def test_options_of_a_capture_beside_a_scan(tmp_path):
    scan = PERSON / "scans" / "scan_000000.ply"
    for name in ("keypoints", "masks"):
        with pytest.raises(InputError, match=f"option {name}"):
            Build(run_folder=tmp_path / "run", scan=scan, **{name: tmp_path}).plan()
    with pytest.raises(InputError, match="either --capture or --scan"):
        Build(run_folder=tmp_path / "run").plan()
    assert not (tmp_path / "run").exists()


def test_the_frame_of_the_capture_is_kept_apart_from_the_row_of_a_file(tmp_path):
    """Parameters of a frame alone are row 0 of their file; a training has to know which frame's photographs are its."""
    capture = tmp_path / "capture"
    (capture / "scans").mkdir(parents=True)
    (capture / "params").mkdir()
    for frame in (0, 8):
        (capture / "scans" / f"scan_{frame:06d}.ply").touch()
        (capture / "scans" / f"scan_{frame:06d}_labels.npz").touch()
        BodyParams.rest().save(capture / "params" / f"{frame:06d}.npz")
    inputs = Build(run_folder=tmp_path / "run", capture=capture, frame=8).plan().inputs
    assert (inputs.frame, inputs.params_row, inputs.params.name) == (8, 0, "000008.npz")
    save_build(tmp_path, inputs, BuildConfig())
    assert load_build(tmp_path)[0].frame == 8
    stacked = Build(run_folder=tmp_path / "run", scan=inputs.scan, params=inputs.params, frame=8).plan().inputs
    assert (stacked.frame, stacked.params_row) == (8, 8)
