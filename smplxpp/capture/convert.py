"""Write any capture that can be opened in our layout or in ActorsHQ's.

Images become those of pinhole cameras. Files without changes are copied byte for byte. Every file appears whole or not
at all, and an interrupted conversion continues where it stopped.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from smplxpp.capture.cameras import RigCamera
from smplxpp.capture.capture import Capture
from smplxpp.capture.convert_views import ViewOutcome, ViewWriter
from smplxpp.capture.sources import PosedTopology
from smplxpp.capture.writers import (
    save_params_by_row,
    write_calibration_csv,
    write_description,
    write_keypoints,
    write_plain_cameras_json,
)
from smplxpp.core import BodyParams, require_between, require_choice, require_positive, write_ply
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.core.files import as_object, jsonable, read_bytes, read_json
from smplxpp.core.files.atomic import atomic_path, atomic_write_bytes, atomic_write_text

_RECORD = "conversion.json"


@dataclass(frozen=True)
class ConvertConfig:
    """Layout, size and selection of a conversion.

    Attributes:
        layout: "simple" is ours; "actorshq" holds images on black, masks, cameras and parameters.
        scale: factor on the resolution of the images.
        frames: frames that are kept; None: all.
        cameras: cameras that are kept; None: all.
        quality: quality of JPEG images that cannot be copied.

    Raises:
        InputError: an unknown layout, a scale that is not above 0, a quality out of range.
    """

    layout: Literal["simple", "actorshq"] = "simple"
    scale: float = 1.0
    frames: tuple[int, ...] | None = None
    cameras: tuple[str, ...] | None = None
    quality: int = 95

    def __post_init__(self) -> None:
        require_choice("--layout", self.layout, ("simple", "actorshq"))
        require_positive("--scale", self.scale)
        require_between("--scale", self.scale, 0, 4)
        require_between("--quality", self.quality, 1, 100)


@dataclass(frozen=True)
class Conversion:
    """Counts and notes of a finished conversion.

    Attributes:
        out: folder of the new capture.
        views: number of its views.
        copied: number of files copied without change.
        encoded: number of files encoded.
        kept: number of files that an earlier call had written.
        left_out: notes on what could not be converted.
    """

    out: Path
    views: int
    copied: int
    encoded: int
    kept: int
    left_out: tuple[str, ...]


def convert_capture(
    capture: Capture, out: Path, config: ConvertConfig | None = None, *, progress: ProgressCallback = ignore_progress
) -> Conversion:
    """Write a capture to another folder in another layout, size or selection.

    Rays and pixels are those of the opened capture: undistorted, resized. Views with damaged files are left out and
    named. Cameras and description are written last, so that an unfinished folder cannot be opened as a capture.

    Args:
        capture: the capture at full size.
        out: a new or an empty folder, or that of the same conversion, interrupted.
        config: layout, size and selection.
        progress: called with the share of the views that is written.

    Raises:
        InputError: cameras or frames that the capture does not have, or a folder with other files.
        OSError: the system refused a file, as on a full disk; its notes tell how many views are written.
    """
    config = config or ConvertConfig()
    # Check the request and claim the folder before anything is written.
    cameras, frames = _chosen(capture, config)
    out = Path(out).absolute()
    claim_folder(capture, out, asdict(config))
    source = capture if config.scale == 1.0 else capture.resized(config.scale)
    # Views come first, then everything else, so that an interruption can be continued.
    views = source.views(cameras, frames)
    outcomes: list[ViewOutcome] = []
    try:
        _write_views(source, views, outcomes, out, config, progress)
        left_out = [outcome.note for outcome in outcomes if outcome.note]
        left_out += _write_rest(capture, source, out, (cameras, frames), config)
    except OSError as error:
        error.add_note(
            f"{out} holds {len(outcomes)} of {len(views)} views and is no capture yet: the same command continues it."
        )
        raise
    copied, encoded, kept = (sum(getattr(o, name) for o in outcomes) for name in ("copied", "encoded", "kept"))
    done = sum(not outcome.note for outcome in outcomes)
    return Conversion(out, done, copied, encoded, kept, tuple(left_out))


def _write_views(
    source: Capture,
    views: Sequence[tuple[str, int]],
    outcomes: list[ViewOutcome],
    out: Path,
    config: ConvertConfig,
    progress: ProgressCallback,
) -> None:
    """Write the views in parallel, and append an outcome for each, also before an error."""
    writer = ViewWriter(source, _root(out, config), config.layout, config.quality)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for outcome in pool.map(writer.write, *zip(*views, strict=True)) if views else ():
                outcomes.append(outcome)
                progress("views", len(outcomes) / len(views))
        except OSError:
            pool.shutdown(cancel_futures=True)  # a full disk stays full
            raise


def _write_rest(
    capture: Capture, source: Capture, out: Path, chosen: tuple[list[str], list[int]], config: ConvertConfig
) -> list[str]:
    """Write all but the views, cameras and description last; return notes on files that cannot be read."""
    cameras, frames = chosen
    left_out = _write_params(capture, out, frames, config)
    if config.layout == "simple":
        _write_geometry(capture, out, frames)
        left_out += _write_keypoints(source, out, cameras, frames)
        write_plain_cameras_json(out / "cameras.json", {n: c for n, c in source.cameras.items() if n in cameras})
        splits = source.splits.restricted(cameras, frames)
        write_description(out / "capture.json", source.recording, splits, frames)
    else:
        # ActorsHQ's layout has a calibration table and no description.
        rig = [RigCamera(source.cameras[c], "body", False) for c in cameras]
        write_calibration_csv(_root(out, config) / "calibration.csv", rig)
    return left_out


def _root(out: Path, config: ConvertConfig) -> Path:
    """Return the folder of the views' files."""
    return out if config.layout == "simple" else out / "1x"


def _chosen(capture: Capture, config: ConvertConfig) -> tuple[list[str], list[int]]:
    """Return the selected cameras and frames, in the capture's order."""
    for name, wanted, have in (
        ("--cameras", config.cameras, tuple(capture.cameras)),
        ("--frames", config.frames, capture.frames),
    ):
        # Name what is unknown, and the first twelve of what there is.
        unknown = [one for one in wanted or () if one not in have]
        if unknown or wanted == () or not have:
            raise InputError(
                name,
                expected=f"some of {', '.join(map(str, have[:12]))}{' ...' if len(have) > 12 else ''}",
                received=", ".join(map(str, unknown[:5])) or "none",
            )
    cameras = [name for name in capture.cameras if config.cameras is None or name in config.cameras]
    frames = [frame for frame in capture.frames if config.frames is None or frame in set(config.frames)]
    return cameras, frames


def claim_folder(capture: Capture, out: Path, choices: Mapping[str, object]) -> None:
    """Refuse a folder of anything but this conversion, and record the conversion in it.

    Args:
        capture: that is converted.
        out: the folder.
        choices: values that make another conversion where they differ.

    Raises:
        InputError: a folder in the capture's or around it, one with other files, or one of another conversion.
    """
    # Neither folder may lie in the other.
    root = capture.root.resolve()
    if out.resolve() == root or root in out.resolve().parents or out.resolve() in root.parents:
        raise InputError("--out", expected="a folder apart from the capture's", received=str(out))
    record = jsonable({"source": str(root), "format": capture.format, **choices})
    path = out / _RECORD
    # A record of the same conversion continues it; any other file is refused.
    if path.is_file():
        recorded = as_object(
            read_json(path, subject="record of a conversion"), subject=f"record of a conversion {path}"
        )
        if recorded != record:
            differ = sorted(key for key in record if record[key] != recorded.get(key))
            raise InputError(
                "--out",
                expected="a new folder, or the one of this very conversion",
                received=f"{out}, where a conversion with other {', '.join(differ)} stands",
                remedy="name another folder",
            )
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("--out", expected="a new or an empty folder", received=str(out), remedy="name another folder")
    atomic_write_text(path, json.dumps(record, indent=1) + "\n")


def _write_params(capture: Capture, out: Path, frames: Sequence[int], config: ConvertConfig) -> list[str]:
    """Write the parameters of the frames; return notes on those that cannot be read."""
    params: dict[int, BodyParams] = {}
    left_out = []
    for frame in frames:
        try:
            found = capture.params(frame)
        except InputError as error:
            left_out.append(str(error))
            continue
        if found is not None:
            params[frame] = found
    if not params:
        return left_out
    if config.layout == "actorshq":
        save_params_by_row(out / "smpl_params.npz", params)
    # One stacked file if frames are numbered from 0 without gaps.
    elif list(params) == list(range(len(params))):
        BodyParams.concatenate(list(params.values())).save(out / "params" / "params.npz")
    else:  # a row for each number would leave gaps
        for frame, p in params.items():
            p.save(out / "params" / f"{frame:06d}.npz")
    return left_out


def _write_keypoints(capture: Capture, out: Path, cameras: Sequence[str], frames: Sequence[int]) -> list[str]:
    """Write the keypoints of the frames that a file has; return notes on files that cannot be read."""
    left_out = []
    for name in cameras:
        try:
            found = capture.keypoints(name)
        except InputError as error:
            left_out.append(str(error))
            continue
        if found is not None:
            kept = [frame for frame in found.frames.tolist() if frame in set(frames)]
            write_keypoints(out / "keypoints" / f"{name}.npz", found.select(found.names, kept))
    return left_out


def _write_geometry(capture: Capture, out: Path, frames: Sequence[int]) -> None:
    """Write true surfaces, and the scans that a template is built from."""
    meshes = capture.recording.meshes
    # True surfaces of one topology are copied; other meshes become scans.
    if isinstance(meshes, PosedTopology):
        atomic_write_bytes(out / "geometry" / "topology.npz", read_bytes(meshes.topology))
        for frame in frames:
            path = meshes.files.path(frame)
            if path is not None:
                atomic_write_bytes(out / "geometry" / f"frame_{frame:06d}.npz", read_bytes(path))
    elif meshes is not None:
        for frame in frames:
            mesh = meshes.read(frame)
            if mesh is not None:
                with atomic_path(out / "scans" / f"scan_{frame:06d}.ply") as temporary:
                    write_ply(temporary, mesh)
    # Scans of our own layout come with labels and other files, which are copied too.
    if capture.format == "simple":
        for frame in frames:
            for path in sorted((capture.root / "scans").glob(f"scan_{frame:06d}*")):
                atomic_write_bytes(out / "scans" / path.name, read_bytes(path))
