"""Read the simple layout of this project, described in docs/captures.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.capture.cameras import read_lenses
from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import IMAGE_SUFFIXES, FileSeries, image_name, subfolders
from smplxpp.capture.keypoints import KeypointFiles, found_keypoints
from smplxpp.capture.protocols import (
    ProtocolFiles,
    choose_protocol,
    description_file,
    read_description,
    read_protocols,
)
from smplxpp.capture.readers.common import ReaderOptions
from smplxpp.capture.recording import TURNTABLE, ParamSource, Problem, Recording, Splits
from smplxpp.capture.sources import ParamFiles, PosedTopology, find_params
from smplxpp.core import Camera, InputError

NAME = "simple"
LOOKS_FOR = "capture.json, or cameras.json or calibration.csv beside rgbs/, or scans/ with params/"
# Folder and part of the name of each kind of file: masks/CAM/CAM_maskFFFFFF.png.
_FOLDERS = {
    "image": ("rgbs", "rgb"),
    "mask": ("masks", "mask"),
    "label": ("labels", "label"),
    "normal": ("normals", "normal"),
}
_CAMERA_FILES = ("cameras.json", "calibration.csv")


def detect(root: Path) -> bool:
    """Tell whether a folder is in this layout; a calibration.csv alone is ActorsHQ's."""
    described = (root / "capture.json").is_file()
    if described and _declared_format(root) != NAME:
        return False
    if described or ((root / "cameras.json").is_file() and (root / "rgbs").is_dir()):
        return True
    return (root / "scans").is_dir() and (root / "params").is_dir()


def _declared_format(root: Path) -> str:
    """Return the layout that a description names, by default this one; it may describe captures of other layouts."""
    try:
        return str(read_description(root).get("format", NAME))
    except InputError:  # broken: `read` reports it
        return NAME


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find the files and calibration of a capture.

    Raises:
        InputError: images without a camera file, a broken camera file or description.
    """
    lenses = _lenses(root)
    description = read_description(root)
    try:
        return _described(root, lenses, description, options)
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"file {description_file(root)}",
            expected="an object with the keys of docs/captures.md",
            received=f"{type(error).__name__}: {error}",
        ) from None


def _described(
    root: Path, lenses: list[tuple[Camera, Distortion | None]], description: Mapping[str, Any], options: ReaderOptions
) -> Recording:
    cameras = {camera.name: camera for camera, _ in lenses}
    protocol = choose_protocol(root, description, options.protocol)
    files, problems = _files(root, cameras, description, protocol)
    topology, frames = root / "geometry" / "topology.npz", r"frame_(?P<frame>\d{6})\.npz"
    recording = Recording(
        name=str(description.get("name", root.resolve().name)),
        root=root,
        format=NAME,
        cameras=cameras,
        distortions={camera.name: distortion for camera, distortion in lenses if distortion is not None},
        files=files,
        background=_background(description),
        label_set=str(description.get("label_set", "capture")),
        params=_params(root, options, protocol),
        meshes=PosedTopology(topology, FileSeries.find(topology.parent, frames)) if topology.is_file() else None,
        keypoints=_keypoints(root, cameras, protocol, options),
        fps=None if description.get("fps") is None else float(description["fps"]),
        problems=tuple(problems),
        protocol=protocol.name,
        protocols=tuple(read_protocols(description)),
        kind=_kind(description, cameras),
    )
    return replace(recording, splits=_splits(recording, description)) if description else recording


def _kind(description: Mapping[str, Any], cameras: Mapping[str, Camera]) -> str | None:
    """Return the kind of capture that a description states; a person who turns does so before one camera."""
    kind = description.get("kind")
    if kind is not None and (kind != TURNTABLE or len(cameras) != 1):
        raise InputError(
            "kind in capture.json",
            expected=f'"{TURNTABLE}" with one camera, or null',
            received=f"{kind!r} with {len(cameras)} cameras",
        )
    return kind


def _keypoints(
    root: Path, cameras: Mapping[str, Camera], protocol: ProtocolFiles, options: ReaderOptions
) -> KeypointFiles | None:
    if protocol.keypoints is None:
        return None
    return found_keypoints(root / protocol.keypoints, cameras, format="auto", person=options.person)


def stacked_params(root: Path, name: str | Path | None = None) -> Path:
    """Return the stacked parameter file of a capture: `params/params.npz`, or another by path or name in `params/`."""
    if name is None:
        return root / "params" / "params.npz"
    path = Path(name)
    inside = root / "params" / path.name
    return inside if not path.is_file() and inside.is_file() else path


def _params(root: Path, options: ReaderOptions, protocol: ProtocolFiles) -> ParamSource | None:
    """Return the parameters of the options, else of the protocol, else single files, else the stacked file."""
    if options.params is not None:
        return find_params(stacked_params(root, options.params), body=options.body)
    if protocol.name is not None:
        named = protocol.parameter_file(root)
        return None if named is None else find_params(named, body=options.body)
    single = FileSeries.find(root / "params", r"(?P<frame>\d{6})\.npz")
    if len(single):
        return ParamFiles(single, body=options.body)
    stacked = stacked_params(root)
    return find_params(stacked, body=options.body) if stacked.is_file() else None


def _lenses(root: Path) -> list[tuple[Camera, Distortion | None]]:
    """Read the camera file; a capture without images needs none."""
    path = next((root / name for name in _CAMERA_FILES if (root / name).is_file()), None)
    if path is None:
        if (root / "rgbs").is_dir():
            raise InputError(f"capture {root}", expected="cameras.json or calibration.csv", received="neither")
        return []
    return read_lenses(path)


def _files(
    root: Path, cameras: Mapping[str, Camera], description: Mapping[str, Any], protocol: ProtocolFiles
) -> tuple[dict[str, dict[str, FileSeries]], list[Problem]]:
    files: dict[str, dict[str, FileSeries]] = {}
    problems = []
    chosen = {"label": protocol.labels, "normal": protocol.normals}
    # Each kind has its folder; a protocol may name another one for labels and normals, or none.
    for kind, (own, tag) in _FOLDERS.items():
        folder = chosen.get(kind, own)
        if folder is None:
            continue
        suffixes = (*IMAGE_SUFFIXES, ".npy") if kind == "label" else IMAGE_SUFFIXES
        found = {
            name: FileSeries.find(root / folder / name, image_name(f"{name}_{tag}", suffixes=suffixes))
            for name in cameras
        }
        files[kind] = {name: series for name, series in found.items() if len(series)}
        # A folder without calibration is reported: its images would be ignored in silence.
        for name in sorted(set(subfolders(root / folder)) - set(cameras)):
            problems.append(
                Problem(f"{root / folder / name}: a folder of camera {name}, which is not calibrated", name)
            )
        # A list of expected frames describes the capture's default folder only.
        listed = description.get(f"{kind}s", {}) if folder == own else {}
        for name, frames in listed.items() if isinstance(listed, Mapping) else ():
            if name in found:
                missing = np.setdiff1d(np.asarray(frames, dtype=np.int64), found[name].numbers).tolist()
                problems += [Problem(f"{root / folder / name}: no {kind} of frame {f}", name, f) for f in missing]
    return files, problems


def _background(description: Mapping[str, Any]) -> tuple[float, float, float] | None:
    # Black without a description, as in ActorsHQ; null declares photographs with their own background.
    value = description.get("background", (0.0, 0.0, 0.0))
    if value is None:
        return None
    colour = np.asarray(value, dtype=np.float64)
    if colour.shape != (3,) or not ((colour >= 0) & (colour <= 1)).all():
        raise InputError(
            "background in capture.json", expected="null, or red, green, blue from 0 to 1", received=str(value)
        )
    return tuple(colour.tolist())


def _splits(recording: Recording, description: Mapping[str, Any]) -> Splits:
    """Return the splits of a description; what it does not hold out is for training."""
    cameras, frames = list(recording.cameras), recording.frames()
    novel_views = _names(description, "novel_views", cameras) or []
    train_views = _names(description, "train_views", cameras)
    novel_frames = _ranges(description, "novel_pose_frames", frames) or []
    train_frames = _ranges(description, "train_frames", frames)
    return Splits(
        # A split that is named is taken as it is; else everything that is not held out is trained on.
        tuple(train_views if train_views is not None else [c for c in cameras if c not in novel_views]),
        tuple(novel_views),
        tuple(train_frames if train_frames is not None else [f for f in frames if f not in set(novel_frames)]),
        tuple(novel_frames),
    )


def _names(description: Mapping[str, Any], key: str, cameras: list[str]) -> list[str] | None:
    if key not in description:
        return None
    if not isinstance(description[key], list):
        raise InputError(f"{key} of the capture", expected="a list of cameras", received=f"{description[key]}")
    unknown = sorted(set(description[key]) - set(cameras))
    if unknown:
        raise InputError(f"{key} of the capture", expected=f"cameras among {cameras}", received=f"{unknown}")
    return list(description[key])


def _ranges(description: Mapping[str, Any], key: str, frames: tuple[int, ...]) -> list[int] | None:
    """Return the frames within the inclusive range [first, last] or any of several ranges; None without a key."""
    if key not in description:
        return None
    try:
        ranges = np.asarray(description[key], dtype=np.int64).reshape(-1, 2)
    except (TypeError, ValueError):
        raise InputError(
            f"{key} of the capture", expected="[first, last], or a list of these", received=f"{description[key]}"
        ) from None
    return [frame for frame in frames if any(first <= frame <= last for first, last in ranges)]
