"""Long takes in chunks: what is joined is what one run makes, and a seam that shows is found."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pipelines.batch.frames import (
    OVERLAP,
    frames_option,
    join_metrics,
    join_reconstructions,
    join_registrations,
)
from pipelines.batch.jobs import Job
from pipelines.cli import main
from pipelines.commands.batch import check_options
from pipelines.commands.batch_frames import options_of
from pipelines.commands.metrics import Metrics, over_frames
from pipelines.runs.artefacts import load_stacked_params
from smplxpp.body import load_body
from smplxpp.build.register import stacked_rows
from smplxpp.core import BodyParams, InputError, TriangleMesh
from smplxpp.core.files.array_file import write_arrays
from smplxpp.core.mesh_files.mesh_io import write_ply
from smplxpp.core.spread import split_frames
from tests.batch.made import write_manifest

BODY = load_body()
FRAMES = 36


def statuses(checks) -> dict[str, str]:
    return {check.name: check.status for check in checks}


def walk(frames: int) -> BodyParams:
    """A person who walks to and fro and waves."""
    time = np.arange(frames) / 20.0
    arrays = BodyParams.rest(betas=BODY.num_betas, expressions=BODY.num_expressions).as_dict()
    arrays = {k: np.repeat(np.atleast_2d(v), frames, axis=0) for k, v in arrays.items() if np.ndim(v) == 2}
    arrays["transl"][:, 2] = 0.5 * np.sin(2.0 * time)
    arrays["body_pose"][:, 47] = 0.8 * np.sin(5.0 * time)
    arrays["betas"][:] = 0.3
    return BodyParams.from_mapping({**arrays, "fps": 20.0}, source="walk")


def write_chunks(folder, params, size, *, planted=None):
    """Runs of the chunks of a take; `planted` changes the parameters of the second."""
    chunks = split_frames(range(len(params)), size, overlap=OVERLAP)
    runs = []
    for k, chunk in enumerate(chunks):
        own = params.select(list(chunk.frames)).as_dict()
        if planted is not None and k == 1:
            planted(own)
        run = folder / chunk.name
        (run / "05_register").mkdir(parents=True)
        made = BodyParams.from_mapping(own, source="chunk")
        write_arrays(run / "05_register" / "params.npz", stacked_rows(chunk.frames, made))
        runs.append(run)
    return chunks, runs


def test_chunks_keep_every_frame_once_and_overlap():
    chunks = split_frames([*range(0, 50), *range(60, 75)], 20, overlap=3)
    assert [frame for chunk in chunks for frame in chunk.kept] == [*range(0, 50), *range(60, 75)]
    assert {len(chunk.kept) for chunk in chunks} == {16, 17}  # and no short one at the end
    assert chunks[1].frames[:3] == chunks[0].kept[-3:] and chunks[0].frames[-3:] == chunks[1].kept[:3]
    assert frames_option(chunks[0].frames) == "0:20" and frames_option(range(0, 30, 10)) == "0:21:10"
    assert frames_option((1, 2, 9)) == "1,2,9" and frames_option((4,)) == "4"
    with pytest.raises(InputError, match="at least one"):
        split_frames([], 5)


def test_a_registration_in_chunks_is_the_whole_one(tmp_path):
    whole = walk(FRAMES)
    chunks, runs = write_chunks(tmp_path / "runs", whole, 12)
    checks = join_registrations(chunks, runs, tmp_path / "out", body=BODY)
    frames, joined = load_stacked_params(tmp_path / "out" / "params.npz")
    assert frames == tuple(range(FRAMES)) and len(chunks) == 3
    assert all(np.array_equal(a, b) for a, b in zip(joined.as_dict().values(), whole.as_dict().values(), strict=True))
    assert set(statuses(checks).values()) == {"pass"}, checks
    seams = json.loads((tmp_path / "out" / "seams.json").read_text())
    assert [one["frames"] for one in seams["borders"]] == [[11, 12], [23, 24]] and seams["apart"] == [0.0, 0.0]


def test_a_seam_that_shows_is_found(tmp_path):
    def moved(arrays):
        arrays["transl"] = arrays["transl"] + [0.1, 0, 0]

    chunks, runs = write_chunks(tmp_path / "moved", walk(FRAMES), 12, planted=moved)
    found = statuses(join_registrations(chunks, runs, tmp_path / "out", body=BODY))
    assert found["jump at borders of chunks against those inside"] == "fail"
    assert found["chunks in frames that two have solved"] == "fail"

    def grown(arrays):
        arrays["betas"] = arrays["betas"] + 0.5

    chunks, runs = write_chunks(tmp_path / "grown", walk(FRAMES), 12, planted=grown)
    with pytest.raises(InputError, match="one shape"):
        join_registrations(chunks, runs, tmp_path / "out2", body=BODY)
    # A frame that a chunk could not register is absent, and counted.
    arrays = dict(np.load(runs[0] / "05_register" / "params.npz"))
    arrays["transl"][5], arrays["global_orient"][5] = np.nan, np.nan
    write_arrays(runs[0] / "05_register" / "params.npz", arrays)
    checks = join_registrations(chunks[:1], runs[:1], tmp_path / "out3", body=BODY)
    assert statuses(checks)["share of frames registered"] == "warn"


def test_reconstructions_are_joined_file_by_file(tmp_path):
    ball = TriangleMesh(
        np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1.0]]),
        np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 2, 1], [5, 3, 2], [5, 4, 3], [5, 1, 4]]),
    )
    chunks, runs = split_frames(range(6), 3), [tmp_path / "a", tmp_path / "b"]

    def write(scale: float, cell: float) -> None:
        for k, (chunk, run) in enumerate(zip(chunks, runs, strict=True)):
            config = {"reconstruct": {"cell": cell if k else 3.0}, "frames": list(chunk.frames)}
            write_manifest(run, "02_reconstruct", config=config)
            found = {str(frame): {} for frame in chunk.frames if frame != 5}
            content = {"frames": found, "absent": {"5": "no mask"} if k else {}}
            (run / "02_reconstruct" / "reconstruction.json").write_text(json.dumps(content))
            for frame in chunk.frames[: 3 - k]:
                moved = (scale if k else 1.0) * ball.vertices + [0.001 * frame, 0, 0]
                write_ply(run / f"02_reconstruct/scan_{frame:06d}.ply", ball.with_vertices(moved))

    write(1.0, 3.0)
    found = statuses(join_reconstructions(chunks, runs, tmp_path / "out"))
    assert found == {"jump at borders of chunks against those inside": "pass", "share of frames reconstructed": "fail"}
    assert sorted(path.name for path in (tmp_path / "out").glob("*.ply")) == [f"scan_{k:06d}.ply" for k in range(5)]
    assert (tmp_path / "out/scan_000004.ply").read_bytes() == (runs[1] / "02_reconstruct/scan_000004.ply").read_bytes()
    write(1.02, 3.0)
    found = statuses(join_reconstructions(chunks, runs, tmp_path / "out"))
    assert found["jump at borders of chunks against those inside"] == "fail"
    write(1.0, 5.0)
    with pytest.raises(InputError, match="settings"):
        join_reconstructions(chunks, runs, tmp_path / "out")


@pytest.fixture
def pairs(tmp_path):
    """Two folders of five frames of a rough triangle soup."""
    drawn = np.random.default_rng(0)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for frame in range(5):
            vertices = drawn.uniform(size=(60, 3))
            write_ply(tmp_path / name / f"f_{frame:04d}.ply", TriangleMesh(vertices, np.arange(60).reshape(-1, 3)))
    return tmp_path / "a", tmp_path / "b"


def timeless(report):
    """A report without its seconds."""
    return json.loads(json.dumps(report), object_hook=lambda one: {k: v for k, v in one.items() if k != "seconds"})


def test_metrics_of_chunks_are_those_of_the_whole(pairs):
    whole = Metrics(*pairs, samples=200, json=True).run()
    parts = [Metrics(*pairs, samples=200, json=True, frames=frames).run() for frames in ("0:3", "3,4")]
    assert [len(part["frames"]) for part in parts] == [3, 2]
    assert timeless(join_metrics(parts, over_frames)) == timeless(whole)
    with pytest.raises(InputError, match="one preset"):
        join_metrics([parts[0], {**parts[1], "seed": 1}], over_frames)


@pytest.mark.slow
def test_the_command_runs_chunks_and_goes_on(pairs, tmp_path, capsys):
    words = ["batch", "frames", "metrics", str(tmp_path / "out"), "--capture", str(pairs[0]), "--truth", str(pairs[1])]
    assert main([*words, "--size", "3", "--local", "2", "--also", "samples=200", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["chunks"] == 2
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert timeless(found["frames"]) == timeless(Metrics(*pairs, samples=200, json=True).run()["frames"])
    made = (tmp_path / "out/chunks/metrics_000000_000002/metrics.json").stat().st_mtime_ns
    assert main([*words, "--size", "3", "--local", "2", "--also", "samples=200", "--json"]) == 0
    assert (tmp_path / "out/chunks/metrics_000000_000002/metrics.json").stat().st_mtime_ns == made


def test_a_chain_of_a_job_with_frames_asks_for_chunks(tmp_path):
    job = Job("anna", "cap", ("reconstruct", "register", "build"), {"register": {"initial": "none"}}, frames=100)
    check_options((job,))
    words = job.command("register", tmp_path, "cap")
    assert words[:5] == ["batch", "frames", "register", str(tmp_path / "register"), "--capture"]
    also = words[words.index("--also") + 1 : -1]
    assert also == ["initial=none", f"scans={tmp_path / 'reconstruct' / 'scans'}"]
    with pytest.raises(InputError, match="flag"):
        options_of(["--initial", "none"])
    assert job.command("build", tmp_path, "cap")[-3:-1] == ["--params", str(tmp_path / "register" / "params.npz")]
    whole = Job("anna", "cap", ("register", "build"))
    assert whole.command("register", tmp_path, "cap")[:2] == ["register", str(tmp_path / "run")]
    assert "--params" not in whole.command("build", tmp_path, "cap")
