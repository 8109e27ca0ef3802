"""degrade_capture: add to a capture with exact inputs those that trackers and parsers give, with both protocols."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from smplxpp.body import BodyModel, load_body
from smplxpp.capture import Capture, open_capture
from smplxpp.capture.cameras import camera_rig
from smplxpp.capture.writers import save_params_by_row, write_cameras_json, write_description
from smplxpp.core import BodyParams, InputError, ProgressCallback, ignore_progress, require_at_least
from smplxpp.core.files import atomic_folder, atomic_write_text, read_json
from smplxpp.synth.tracker import (
    ESTIMATED_LABELS,
    EXACT_PARAMETERS,
    INPUTS,
    KEYPOINTS,
    TRACKED_PARAMETERS,
    protocols,
    tracker_noise,
    write_estimated_labels,
    write_tracked_keypoints,
)

_DESCRIPTIONS = ("capture.json", "manifest.json")


@dataclass(frozen=True)
class DegradeConfig:
    """Errors, files and cameras of a degraded capture.

    Attributes:
        seed: seed of all errors.
        copy: copy files rather than link them.
        rig: number of cameras of a synthetic ring, for a capture without cameras; 0: no ring and no keypoints.
        size: height of the ring's images in pixels.
    """

    seed: int = 0
    copy: bool = False
    rig: int = 0
    size: int = 640

    def __post_init__(self) -> None:
        require_at_least("--seed", self.seed, 0)
        require_at_least("--rig", self.rig, 0)
        require_at_least("--size", self.size, 16)


@dataclass(frozen=True)
class Degraded:
    """Figures and notes of a degraded capture.

    Attributes:
        out: its folder.
        frames: number of frames with parameters.
        cameras: number of cameras with keypoints.
        labels_wrong: share of foreground pixels with a wrong label.
        left_out: notes on files that could not be made.
    """

    out: Path
    frames: int
    cameras: int
    labels_wrong: float
    left_out: tuple[str, ...]


def degrade_capture(
    source: Path,
    out: Path,
    config: DegradeConfig | None = None,
    *,
    body: BodyModel | None = None,
    progress: ProgressCallback = ignore_progress,
) -> Degraded:
    """Write a capture with exact inputs and those that trackers would give, whole or not at all.

    All files of the source are linked except its description and its keypoints. Added are `params/params_noisy.npz`
    where there is none, `keypoints/` from the exact parameters, `labels_estimated/` from the label maps, and
    `capture.json` with the keys of the old description, "inputs" and "protocols".

    Args:
        source: folder of a capture in our layout whose parameters and labels are exact.
        out: a new folder apart from it.
        config: settings.
        body: body model of the parameters; None: the open body.
        progress: called with the name of the current work and the share of it that is done.

    Raises:
        InputError: another layout, no parameters, a rig for a capture with cameras, or a folder with other files.
    """
    config, body = config or DegradeConfig(), body or load_body()
    source, out = Path(source).resolve(), Path(out).absolute()
    capture = open_capture(source, body=body, cache_bytes=0)
    params = {frame: found for frame in capture.frames if (found := capture.params(frame)) is not None}
    _check(capture, params, out, config)
    description = _description(source)
    left_out = []
    with atomic_folder(out) as root:
        # Link what stays, then write parameters, cameras, keypoints and labels, and the description last.
        _link(source, root, copy=config.copy)
        _write_params(root / "params", params, config.seed)
        if config.rig:
            _write_rig(root / "cameras.json", body, params, config)
            # Open the new folder, which has the ring's cameras.
            shown = open_capture(root, cache_bytes=0)
        else:
            shown = capture
        if shown.cameras:
            write_tracked_keypoints(
                root, shown, body, params, seed=config.seed, progress=lambda share: progress("keypoints", share)
            )
        else:
            left_out.append("keypoints: the capture has no cameras; --rig N makes a ring of them")
        wrong = write_estimated_labels(root, shown, seed=config.seed, progress=lambda share: progress("labels", share))
        has = {kind: any(capture.recording.files.get(kind, {}).values()) for kind in ("label", "normal")}
        if not has["label"]:
            left_out.append("label maps: the capture has none to degrade")
        if not description:
            write_description(root / _DESCRIPTIONS[0], capture.recording, shown.splits, capture.frames)
            description = _description(root)
        kinds = protocols(labels=has["label"], normals=has["normal"], keypoints=bool(shown.cameras))
        content = {**description, "inputs": description.get("inputs", INPUTS), "protocols": kinds}
        atomic_write_text(root / _DESCRIPTIONS[0], json.dumps(content, indent=1) + "\n")
    return Degraded(out, len(params), len(shown.cameras), wrong, tuple(left_out))


def _check(capture: Capture, params: dict[int, BodyParams], out: Path, config: DegradeConfig) -> None:
    root = capture.root.resolve()
    if capture.format != "simple":
        raise InputError(
            "capture",
            expected="our own layout",
            received=capture.format,
            remedy="convert it first (smplxpp capture convert)",
        )
    if not params:
        raise InputError(f"capture {root}", expected="exact body parameters", received="none")
    if config.rig and capture.cameras:
        raise InputError("--rig", expected="a capture without cameras", received=f"{len(capture.cameras)} cameras")
    # Neither folder may lie in the other, or a copy would contain itself.
    if out == root or root in out.resolve().parents or out.resolve() in root.parents:
        raise InputError("--out", expected="a folder apart from the capture's", received=str(out))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("--out", expected="a new or an empty folder", received=str(out), remedy="name another folder")


def _description(root: Path) -> dict:
    path = next((root / name for name in _DESCRIPTIONS if (root / name).is_file()), None)
    return {} if path is None else dict(read_json(path))


def _link(source: Path, root: Path, *, copy: bool) -> None:
    """Link or copy every file except those that are written new; links of the source are followed."""
    for folder, folders, files in os.walk(source, followlinks=True):
        place = Path(folder).relative_to(source)
        # Keypoints, labels and description of the source are replaced.
        if place == Path():
            folders[:] = [name for name in folders if name not in (KEYPOINTS, ESTIMATED_LABELS)]
            files = [name for name in files if name not in _DESCRIPTIONS]
        (root / place).mkdir(parents=True, exist_ok=True)
        for name in sorted(files):
            origin = (Path(folder) / name).resolve()
            if copy:
                shutil.copyfile(origin, root / place / name)
            else:
                (root / place / name).symlink_to(origin)


def _write_params(folder: Path, params: dict[int, BodyParams], seed: int) -> None:
    """Write the files of parameters that the protocols name, where they are missing."""
    if not (folder / EXACT_PARAMETERS).exists():
        save_params_by_row(folder / EXACT_PARAMETERS, params)
    if not (folder / TRACKED_PARAMETERS).exists():
        noisy = tracker_noise(BodyParams.concatenate(list(params.values())), seed=seed)
        save_params_by_row(folder / TRACKED_PARAMETERS, {frame: noisy.frame(row) for row, frame in enumerate(params)})


def _write_rig(path: Path, body: BodyModel, params: dict[int, BodyParams], config: DegradeConfig) -> None:
    """Write a ring of cameras that see the person in all frames, for keypoints alone."""
    # Boxes of 16 cm to each side of the joints hold the flesh around them.
    joints = body.forward(BodyParams.concatenate(list(params.values()))).joints
    around = 0.16 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    # Close-ups hold head and neck.
    head = joints[:, [body.joint_names.index(name) for name in ("neck", "head", "jaw") if name in body.joint_names]]

    def boxes(points: np.ndarray) -> np.ndarray:
        return (points.reshape(-1, 1, 3) + around).reshape(-1, 3)

    rig = camera_rig(boxes(joints), boxes(head), count=config.rig, size=config.size, seed=config.seed)
    write_cameras_json(path, [replace(item, novel=False) for item in rig])
