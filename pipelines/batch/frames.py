"""Long takes in chunks of frames: how they are split, how results are joined, and whether the seams show.

| command | what a chunk computes | what is joined | against one run over all frames |
|---|---|---|---|
| `reconstruct` | surfaces of its frames | files, side by side | the same bytes: frames are independent |
| `metrics` | rows of its frames | rows, and their statistics | the same numbers |
| `register` | its frames and `OVERLAP` more on each side, of one shape | rows of its own | others by what smoothness \
carries across a border, which the seams show |

Chunks of a refinement are sums of one solve over all frames: it has no seams, see `avatar.training.refinement.board`.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from pipelines.runs.artefacts import load_stacked_params
from pipelines.runs.folders import read_record
from pipelines.runs.layout import RECONSTRUCT_STAGE, RECONSTRUCTION, REGISTERED_PARAMS, reconstructed_scan
from pipelines.runs.stage import MANIFEST
from smplxpp.body import BodyModel
from smplxpp.build.register import BODY_JOINTS, stacked_rows
from smplxpp.core import BodyParams, Check, InputError, spread
from smplxpp.core.checks import Gate
from smplxpp.core.files.array_file import write_arrays
from smplxpp.core.files.atomic import atomic_path, atomic_write_text
from smplxpp.core.files.json_file import as_object, jsonable, read_json
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.core.spread import Chunk
from smplxpp.metrics import point_to_surface

OVERLAP = 10
"""Frames that a chunk of a registration has beside its own on each side: as many as the windows of one registration."""
JUMP = Gate("x", 1.5, 3.0, higher_is_better=False)
"""Largest jump at a border, as a share of the 99th percentile of the jumps inside of chunks. A motion's own jumps reach
1 to 1.4 there; a chunk with 10 mm more of one thing reaches 3 and more."""
DISAGREEMENT = Gate("mm", 3.0, 10.0, higher_is_better=False)
"""Largest mean distance of the body's joints between two chunks in the frames that both have solved."""


def frames_option(frames: Sequence[int]) -> str:
    """Write frames as commands take them: START:STOP, START:STOP:STEP, or numbers with commas.

    Example:
        >>> frames_option((2, 3, 4)), frames_option((0, 5, 10)), frames_option((1, 7, 8))
        ('2:5', '0:11:5', '1,7,8')
    """
    steps = {after - before for before, after in pairwise(frames)}
    if len(frames) < 3 or len(steps) > 1:
        return ",".join(map(str, frames))
    step = steps.pop()
    return f"{frames[0]}:{frames[-1] + 1}" + (f":{step}" if step > 1 else "")


def shape_frames(frames: Sequence[int], most: int) -> tuple[int, ...]:
    """Return at most `most` frames, spread evenly over a take, whose registration gives the shape of all chunks."""
    return tuple(spread(list(frames), most))


def join_registrations(chunks: Sequence[Chunk], runs: Sequence[Path], out: Path, *, body: BodyModel) -> list[Check]:
    """Join the parameters of chunks into `params.npz`, and write `seams.json` beside it.

    Args:
        chunks: in the order of their frames.
        runs: run folder of each chunk's registration.
        out: folder of the result.
        body: the model that was registered.

    Returns:
        Checks of the seams, and of frames that no chunk could register.

    Raises:
        InputError: a chunk without its registration, or chunks of different shapes.
    """
    rows: dict[int, BodyParams] = {}
    solved: list[dict[int, BodyParams]] = []
    for chunk, run in zip(chunks, runs, strict=True):
        numbers, params = load_stacked_params(run / REGISTERED_PARAMS)
        own = {frame: params.frame(row) for row, frame in enumerate(numbers)}
        solved.append(own)
        rows |= {frame: own[frame] for frame in chunk.kept if frame in own}
    joined = BodyParams.concatenate([rows[frame] for frame in sorted(rows)])
    if np.ptp(joined.betas, axis=0).max() > 0:
        raise InputError(
            "chunks of a registration",
            expected="one shape",
            received="several",
            remedy="register all chunks with the same --shape",
        )
    out.mkdir(parents=True, exist_ok=True)
    write_arrays(out / "params.npz", stacked_rows(sorted(rows), joined))
    borders = [(before.kept[-1], after.kept[0]) for before, after in pairwise(chunks)]
    jumps, inside = _motion_jumps(rows, borders, body)
    # Frames that both neighbours have solved show the seam itself, whatever the motion does there.
    apart = [_apart(solved[k], solved[k + 1], border, body) for k, border in enumerate(borders)]
    checks = seam_checks(jumps, inside, apart)
    wanted = sum(len(chunk.kept) for chunk in chunks)
    checks.append(Check("share of frames registered", len(rows) / wanted, "", 1.0, 0.9, higher_is_better=True))
    _write_seams(out, borders, jumps, inside, checks, apart=apart)
    return checks


def _motion_jumps(
    rows: Mapping[int, BodyParams], borders: Sequence[tuple[int, int]], body: BodyModel
) -> tuple[list[float], list[float]]:
    """Return accelerations of the joints at borders and inside of chunks, mm a frame squared.

    A jump of a frame is the largest second difference of a joint's place over it and its neighbours: a step of d mm
    between two chunks has two of d mm, a steady motion none.
    """
    order, at_border = sorted(rows), {frame for border in borders for frame in border}
    beside = {frame: (before, after) for before, frame, after in zip(order, order[1:], order[2:], strict=False)}
    most = 400  # frames inside of chunks that are compared: the 99th percentile has four above it
    others = spread([frame for frame in beside if frame not in at_border], most)
    known: dict[int, Float64[np.ndarray, "J 3"]] = {}

    def jump(frame: int) -> float | None:
        # Frames beside a gap have no acceleration.
        before, after = beside.get(frame, (frame, frame))
        if frame - before != after - frame or before == after:
            return None
        for one in (before, frame, after):
            if one not in known:
                known[one] = _joints(rows[one], body)
        second = known[after] - 2.0 * known[frame] + known[before]
        return 1e3 * float(np.linalg.norm(second, axis=1).max())

    jumps = [max((j for frame in border if (j := jump(frame)) is not None), default=np.nan) for border in borders]
    return jumps, [j for frame in others if (j := jump(frame)) is not None]


def _joints(params: BodyParams, body: BodyModel) -> Float64[np.ndarray, "J 3"]:
    return body.forward(params).joints[0, :BODY_JOINTS]


def _apart(
    before: Mapping[int, BodyParams], after: Mapping[int, BodyParams], border: tuple[int, int], body: BodyModel
) -> float:
    """Return the mean distance of the joints between two chunks at their border, mm; NaN where one lacks it."""
    both = [frame for frame in border if frame in before and frame in after]
    found = [np.linalg.norm(_joints(before[f], body) - _joints(after[f], body), axis=1).mean() for f in both]
    return 1e3 * float(max(found)) if found else float("nan")


def join_reconstructions(chunks: Sequence[Chunk], runs: Sequence[Path], out: Path) -> list[Check]:
    """Join the surfaces of chunks: `scan_FFFFFF.ply` of every frame side by side, and `seams.json` beside them.

    Args:
        chunks: in the order of their frames.
        runs: run folder of each chunk's reconstruction.
        out: folder of the result, as `smplxpp register --scans` takes it.

    Raises:
        InputError: a chunk without its reconstruction, or chunks that were made with different settings.
    """
    out.mkdir(parents=True, exist_ok=True)
    settings: set[str] = set()
    absent: dict[str, Any] = {}
    for chunk, run in zip(chunks, runs, strict=True):
        config = {k: v for k, v in read_record(run / RECONSTRUCT_STAGE / MANIFEST)["config"].items() if k != "frames"}
        settings.add(json.dumps(config, sort_keys=True))
        content = as_object(read_json(run / RECONSTRUCTION, subject="reconstruction"), subject=f"file {run}")
        absent |= {frame: words for frame, words in content.get("absent", {}).items() if int(frame) in chunk.kept}
        for frame in chunk.kept:
            scan = run / reconstructed_scan(frame)
            if str(frame) in content.get("frames", {}):
                with atomic_path(out / scan.name) as path:
                    shutil.copyfile(scan, path)
    if len(settings) > 1:
        raise InputError("chunks of a reconstruction", expected="the same cameras and settings", received="others")
    # Surfaces of frames are independent, so that a seam can only be a difference of settings or of files.
    borders = [(before.kept[-1], after.kept[0]) for before, after in pairwise(chunks)]
    inside = [pair for chunk in chunks for pair in pairwise(chunk.kept)]
    jumps = [_surface_jump(out, *border) for border in borders]
    around = [jump for pair in spread(inside, 40) if np.isfinite(jump := _surface_jump(out, *pair))]
    checks = seam_checks(jumps, around, [])
    wanted = sum(len(chunk.kept) for chunk in chunks)
    checks.append(
        Check("share of frames reconstructed", 1.0 - len(absent) / wanted, "", 1.0, 0.9, higher_is_better=True)
    )
    _write_seams(out, borders, jumps, around, checks, absent=absent)
    return checks


def _surface_jump(folder: Path, before: int, after: int) -> float:
    """Return the mean distance of vertices of one frame's surface to the next one's, mm; NaN where one is absent."""
    files = [folder / Path(reconstructed_scan(frame)).name for frame in (before, after)]
    if not all(file.is_file() for file in files):
        return float("nan")
    first, second = (read_mesh(file).mesh for file in files)
    chosen = np.array(spread(list(range(first.vertex_count)), 2000))
    return 1e3 * float(point_to_surface(first.vertices[chosen], second)[0].mean())


def join_metrics(reports: Sequence[Mapping[str, Any]], statistics: Callable[[list[Any]], Any]) -> dict[str, Any]:
    """Join the answers of `smplxpp metrics` for chunks into what one call over all frames answers.

    Args:
        reports: of each chunk.
        statistics: of all frames' entries.

    Raises:
        InputError: reports of different conventions, samples or seeds.
    """
    shared = ("preset", "samples", "seed", "threshold_mm", "visible_only")
    if len({json.dumps([report.get(name) for name in shared]) for report in reports}) > 1:
        raise InputError("chunks of metrics", expected="one preset, number of samples and seed", received="several")
    frames = [one for report in reports for one in report["frames"]]
    skipped = [one for report in reports for one in report["skipped"]]
    return {**reports[0], "frames": frames, "over_frames": statistics(frames), "skipped": skipped}


def seam_checks(jumps: Sequence[float], inside: Sequence[float], apart: Sequence[float]) -> list[Check]:
    """Hold the jumps at borders against those inside of chunks, and what neighbours made of the same frames.

    Args:
        jumps: at each border; NaN where a frame is missing.
        inside: the same between frames of one chunk.
        apart: distance of two chunks in a frame that both have, mm; empty where none has two results.
    """
    checks = []
    seen = [jump for jump in jumps if np.isfinite(jump)]
    if seen and inside:
        usual, worst = max(float(np.percentile(inside, 99)), 1e-9), max(seen)
        words = f"{worst:.2f} mm at the worst of {len(seen)} borders; of {len(inside)} inside 99 % below {usual:.2f}"
        checks.append(JUMP.check("jump at borders of chunks against those inside", worst / usual, explanation=words))
    known = [one for one in apart if np.isfinite(one)]
    if known:
        checks.append(DISAGREEMENT.check("chunks in frames that two have solved", max(known)))
    return checks


def _write_seams(
    out: Path,
    borders: Sequence[tuple[int, int]],
    jumps: Sequence[float],
    inside: Sequence[float],
    checks: Sequence[Check],
    **more: Any,
) -> None:
    """Write `seams.json`: jumps at each border and statistics of those inside, mm, and the checks."""
    percentiles = np.percentile(inside, [50, 95, 99]).tolist() if inside else []
    content = {
        "borders": [{"frames": border, "jump_mm": jump} for border, jump in zip(borders, jumps, strict=True)],
        "inside_mm": dict(zip(("p50", "p95", "p99"), percentiles, strict=False)),
        **more,
        "checks": [check.as_dict() for check in checks],
    }
    atomic_write_text(out / "seams.json", json.dumps(jsonable(content), indent=1) + "\n")
