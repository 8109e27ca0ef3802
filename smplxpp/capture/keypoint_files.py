"""Read keypoint files of OpenPose, EasyMocap, mmpose, COCO and MediaPipe, and this project's npz.

Keypoints are one file of all frames or a folder with a file for each frame; docs/rigs.md describes the layouts.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from smplxpp.capture.keypoint_people import (
    Person,
    body_25_order,
    chosen_person,
    coco_person,
    easymocap_people,
    mediapipe_person,
    mmpose_people,
    openpose_people,
)
from smplxpp.core import InputError, Keypoints2D, require_choice
from smplxpp.core.files.json_file import as_numbers, read_json
from smplxpp.core.files.safe_pickle import safe_npz

KeypointFormat = Literal["auto", "simple", "openpose", "openpose-25b", "easymocap", "mmpose", "coco", "mediapipe"]
_HOLISTIC = ("pose", "face", "left_hand", "right_hand")
T = TypeVar("T")


@dataclass(frozen=True)
class KeypointOptions:
    """Options for reading files of detected keypoints.

    Attributes:
        format: "auto" recognises the format by the content; OpenPose's BODY_25B, which has as many points as BODY_25,
            by the size of the face.
        person: id of the person in the file, else the index in its list; None: in each frame the person with the
            greatest sum of confidences.
        size: width and height of the images, for MediaPipe's normalised coordinates.
        first_frame: number of the first frame, to which all frames are shifted. None: as in the files (mmpose counts
            the frames of a video from 1).
    """

    format: KeypointFormat = "auto"
    person: int | None = None
    size: tuple[int, int] | None = None
    first_frame: int | None = None

    def __post_init__(self) -> None:
        require_choice("format of the keypoints", self.format, get_args(KeypointFormat))


def read_keypoints(path: str | Path, options: KeypointOptions | None = None) -> Keypoints2D:
    """Read the keypoints of one camera, in pixels of the images on disk (distorted if they are), centres at +0.5.

    Args:
        path: one file of all frames, or a folder with a JSON file for each frame, whose last number is the frame; or a
            capture's folder of keypoints, if these are of one camera.
        options: format, person and image size.

    Raises:
        InputError: no file, a damaged file, an unknown layout, or another number of points than the layout has.
    """
    path, options = _of_one_camera(Path(path)), options or KeypointOptions()
    return _named_errors(path, lambda: _read(path, options))


def read_people(path: str | Path, options: KeypointOptions | None = None) -> dict[int, list[Person]]:
    """Read all people of one camera by frame, in pixels of the images on disk, centres at +0.5.

    Args:
        path: as `read_keypoints`, but no npz of this project, which has one person.
        options: format and image size; `person` and `first_frame` are not applied.

    Raises:
        InputError: as `read_keypoints`.
    """
    path, options = Path(path), options or KeypointOptions()
    return _named_errors(path, lambda: _people(path, options))


def _named_errors(path: Path, read: Callable[[], T]) -> T:
    """Turn what a broken layout raises into an error that names the file."""
    try:
        return read()
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"keypoints {path}",
            expected="one of the layouts of docs/rigs.md",
            received=f"{type(error).__name__}: {error}",
        ) from None


def _read(path: Path, options: KeypointOptions) -> Keypoints2D:
    # An npz of our own layout has names; otherwise it holds MediaPipe's arrays.
    if path.suffix.lower() == ".npz" and path.is_file() and options.format in ("auto", "simple"):
        arrays = safe_npz(path)
        if "joint_names" in arrays:
            return _own_layout(arrays, path)
    frames = _people(path, options)
    # One person a frame; by id if the user names one, else the most confident.
    chosen = {number: chosen_person(people, options.person) for number, people in frames.items()}
    if options.person is not None and not any(chosen.values()):
        ids = sorted({-1 if one.id is None else one.id for people in frames.values() for one in people})
        raise InputError("--person", expected=f"one of the ids {ids[:12]}, or a place", received=str(options.person))
    return joined(chosen, options.first_frame)


def _people(path: Path, options: KeypointOptions) -> dict[int, list[Person]]:
    """Read the people of all frames."""
    frames: dict[int, list[Person]] = {}
    if options.format == "auto":
        options = replace(options, format=_order_of(path))
    if path.suffix.lower() == ".npz" and path.is_file():
        frames = dict(_mediapipe_arrays(safe_npz(path), path, options))
    elif path.is_dir():
        files = frame_files(path)
        for number in sorted(files):
            frames.update(_frames(read_json(files[number]), number, options, source=f"file {files[number]}"))
    elif path.is_file():
        frames = dict(_frames(read_json(path), 0, options, source=f"file {path}"))
    if not frames:
        raise InputError(
            f"keypoints {path}",
            expected="an npz or JSON file, or a folder of JSON files with a number each",
            received="nothing of the kind" if path.exists() else "no such file",
        )
    return frames


def _of_one_camera(path: Path) -> Path:
    """Return the only file or folder of a camera in a folder without files of frames, else the path itself."""
    if not path.is_dir() or frame_files(path):
        return path
    cameras = [p for p in sorted(path.iterdir()) if p.suffix.lower() == ".npz" or (p.is_dir() and frame_files(p))]
    return cameras[0] if len(cameras) == 1 else path


def frame_files(folder: Path) -> dict[int, Path]:
    """Return the JSON files of a folder by frame, the last number of the name (`CAM_000012_keypoints.json`)."""
    return {_last_number(p): p for p in sorted(folder.iterdir()) if p.suffix.lower() == ".json"}


def _order_of(path: Path) -> KeypointFormat:
    """Recognise OpenPose's order of 25 points from detected people; "auto" for other counts of points.

    Raises:
        InputError: lists of 25 points whose order cannot be recognised.
    """
    order = body_25_order(sampled_people(path))
    if order == "unclear":
        raise InputError(
            f"keypoints {path}",
            expected="25 points of which the face tells whether they are BODY_25 or BODY_25B",
            received="no face, or one of the same size in both orders",
            remedy="name the order: smplxpp keypoints convert --format openpose (BODY_25) or openpose-25b",
        )
    return "auto" if order == "none" else order


def sampled_people(path: Path) -> Iterator[Any]:
    """Yield `pose_keypoints_2d` of the people in evenly spread files; nothing for files of other formats."""
    sampled = 40  # files of a camera that tell the order of OpenPose's 25 points
    if path.suffix.lower() == ".npz":
        return
    files = list(frame_files(path).values()) if path.is_dir() else [path] if path.is_file() else []
    for file in files[:: max(1, len(files) // sampled)]:
        content = read_json(file)
        people = content.get("people") if isinstance(content, Mapping) else None
        for one in people if isinstance(people, list) else ():
            numbers = one.get("pose_keypoints_2d") if isinstance(one, Mapping) else None
            if isinstance(numbers, list):
                yield numbers


def joined(chosen: Mapping[int, Person | None], first_frame: int | None) -> Keypoints2D:
    """Join the chosen person of each frame into one table; frames without one are all 0."""
    # Detectors may leave points out, so that the columns are the union of all names in order of first appearance.
    names = tuple(dict.fromkeys(name for one in chosen.values() if one is not None for name in one.points))
    numbers, column = sorted(chosen), {name: k for k, name in enumerate(names)}
    # (F, K, 3): u, v in pixels and confidence, 0 where a point is missing.
    table = np.zeros((len(numbers), len(names), 3))
    for row, number in enumerate(numbers):
        one = chosen[number]
        for name, point in one.points.items() if one is not None else ():
            table[row, column[name]] = point
    # The numbers of files may start anywhere; `first_frame` says which frame of the capture the first one is.
    shift = 0 if first_frame is None else first_frame - numbers[0]
    return Keypoints2D(names, np.array(numbers, dtype=np.int64) + shift, table[..., :2], table[..., 2])


def _own_layout(arrays: Mapping[str, Any], path: Path) -> Keypoints2D:
    """Read this project's layout: `keypoints` (frames, K, 3), `joint_names` and perhaps `frames`."""
    values = np.asarray(arrays.get("keypoints"), dtype=np.float64)
    names = tuple(str(name) for name in np.ravel(arrays["joint_names"]))
    # Missing points are rows of zeros, so that the array has no gaps.
    if values.ndim != 3 or values.shape[1:] != (len(names), 3):
        raise InputError(
            f"file {path}: keypoints", expected=f"shape (frames, {len(names)}, 3)", received=f"shape {values.shape}"
        )
    frames = _frame_numbers(arrays, len(values), path)
    try:
        return Keypoints2D(names, frames, values[..., :2], values[..., 2])
    except InputError as error:
        raise InputError(f"file {path}: keypoints", expected=error.expected, received=error.received) from None


def _frames(content: Any, number: int, options: KeypointOptions, *, source: str) -> Iterator[tuple[int, list[Person]]]:
    """Yield the people of each frame of a JSON file; `number` is the frame of a file without frame numbers."""
    # One branch for each format: some hold one frame, others a list of frames or of detections.
    kind = _kind(content) if options.format == "auto" else options.format
    if kind in ("openpose", "openpose-25b"):
        yield number, openpose_people(content, body_25b=kind == "openpose-25b", source=source)
    elif kind == "easymocap":
        yield number, easymocap_people(content, body_25b=False, source=source)
    # mmpose: either a list of frames, each with `instances`, or the instances of one frame.
    elif kind == "mmpose":
        entries = content["instance_info"] if isinstance(content, Mapping) else content
        if all("instances" in entry for entry in entries) and entries:
            for place, entry in enumerate(entries):
                frame = int(entry.get("frame_id", number + place))
                yield frame, mmpose_people(entry["instances"], source=source)
        else:
            yield number, mmpose_people(entries, source=source)
    elif kind == "coco":
        # A flat list of detections: gather those of one image.
        by_image: dict[int, list[Person]] = {}
        for entry in content["annotations"] if isinstance(content, Mapping) else content:
            image = entry["image_id"]
            frame = image if isinstance(image, int) else _last_number(Path(image))
            by_image.setdefault(frame, []).append(coco_person(entry, source=source))
        yield from by_image.items()
    # MediaPipe has no standard file; the parts of its Holistic result are looked for by name.
    elif kind == "mediapipe":
        entries = content.get("frames", [content]) if isinstance(content, Mapping) else content
        normalised = content.get("normalized") if isinstance(content, Mapping) else None
        for place, entry in enumerate(entries):
            parts = {name: entry.get(f"{name}_landmarks", entry.get(name)) for name in _HOLISTIC}
            frame = int(entry.get("frame", number + place))
            yield frame, [mediapipe_person(parts, size=options.size, normalised=normalised, source=source)]
    else:
        raise InputError(source, expected="keypoints in a layout of docs/rigs.md", received="JSON of another kind")


def _kind(content: Any) -> str:
    """Recognise the format by the keys of a JSON file; "" if none fits."""
    # Objects with a list at the top: the key names the format.
    if isinstance(content, Mapping):
        for key, kind in (("people", "openpose"), ("annots", "easymocap"), ("instance_info", "mmpose")):
            if key in content:
                return kind
        if "annotations" in content:
            return "coco"
        # Lists: the first entry's keys tell the format.
        first = next(iter(content.get("frames", [])), content)
    else:
        first = content[0] if content else {}
    if "image_id" in first:
        return "coco"
    if "instances" in first or "keypoint_scores" in first or content == []:
        return "mmpose"
    if "handl2d" in first or "personID" in first:
        return "easymocap"
    return "mediapipe" if any(f"{name}{tail}" in first for name in _HOLISTIC for tail in ("_landmarks", "")) else ""


def _mediapipe_arrays(
    arrays: Mapping[str, Any], path: Path, options: KeypointOptions
) -> Iterator[tuple[int, list[Person]]]:
    parts = {name: arrays.get(f"{name}_landmarks", arrays.get(name)) for name in _HOLISTIC}
    # Each part is (F, n, 3 or 4); all parts need the same number of frames.
    have = {name: np.asarray(values, dtype=np.float64) for name, values in parts.items() if values is not None}
    counts = {len(values) for values in have.values()}
    if len(counts) != 1:
        raise InputError(
            f"file {path}",
            expected="arrays `keypoints` and `joint_names`, or MediaPipe's `pose`, `face`, `left_hand`, `right_hand` "
            "with a row a frame each",
            received=", ".join(f"{name} {np.shape(value)}" for name, value in arrays.items()) or "nothing",
        )
    count = counts.pop()
    normalised = bool(arrays["normalized"]) if "normalized" in arrays else None
    for row, number in enumerate(_frame_numbers(arrays, count, path).tolist()):
        own = {name: values[row] for name, values in have.items()}
        person = mediapipe_person(own, size=options.size, normalised=normalised, source=f"file {path}")
        yield number, [person]


def _frame_numbers(arrays: Mapping[str, Any], count: int, path: Path) -> np.ndarray:
    """Return the frame numbers in an npz file, or 0, 1, ... without any."""
    if "frames" not in arrays:
        return np.arange(count)
    numbers = as_numbers(np.ravel(arrays["frames"]), (count,), subject=f"file {path}: frames")
    if numbers.size and not (np.abs(numbers).max() < 1 << 53 and np.array_equal(numbers, np.rint(numbers))):
        raise InputError(f"file {path}: frames", expected="whole numbers", received=f"{numbers[:5].tolist()}, ...")
    return numbers.astype(np.int64)


def _last_number(path: Path) -> int:
    """Return the last number in a file name.

    Raises:
        InputError: a name without a number.
    """
    numbers = re.findall(r"\d+", path.stem)
    if not numbers:
        raise InputError(f"file {path}", expected="a name with the frame's number", received=path.name)
    return int(numbers[-1])
