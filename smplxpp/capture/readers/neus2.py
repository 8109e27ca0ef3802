"""Read NeuS2 (Wang et al. 2023), Instant-NGP, nerfstudio, Blender's NeRF scenes: `transform*.json` and images."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import FileSeries
from smplxpp.capture.readers.common import ReaderOptions, chosen_params, required
from smplxpp.capture.readers.transforms import NamedImage, find_image, frame_camera, mask_beside, places, same_camera
from smplxpp.capture.recording import Problem, Recording, Splits
from smplxpp.core import Camera, InputError
from smplxpp.core.files.image_file import image_mode, image_size
from smplxpp.core.files.json_file import as_list, as_number, as_object, as_text, read_json

NAME = "neus2"
LOOKS_FOR = "transform*.json, there or in train/ and test/"
_SETS = ("", "train", "test")
# Names of held-out sets in file names and in nerfstudio's lists.
_HELD_OUT = ("test", "val")
_TRAIN, _TEST, _NEITHER = "train", "test", ""


def detect(root: Path) -> bool:
    """Tell whether a folder holds transform files."""
    return bool(_transform_files(root))


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find the files of a scene; `places` assigns a camera and a frame to each image.

    If `from_na` is present (NeuS2), camera axes are OpenCV's, otherwise OpenGL's. Matrices are camera-to-world in the
    axes and units of the data; `scale` and `offset` describe the trainer's unit cube and are ignored. Files and lists
    of test and val hold the held-out cameras and frames.

    Raises:
        InputError: broken files, unsupported lenses, images outside of the folder, a camera that moves between frames.
    """
    # All images that the transform files name.
    problems: list[Problem] = []
    images: list[NamedImage] = []
    for path in _transform_files(root):
        content = as_object(read_json(path), subject=f"file {path}")
        images += _images(root, path, content, problems)
        problems += _scale_note(path, content)
    if not images:
        received = problems[0].message if problems else "none"
        raise InputError(f"capture {root}", expected="frames with images in transform*.json", received=received)
    problems += _dynamic_masks(root, images)
    # Group them by camera; all frames of a camera must agree on its pose and intrinsics.
    cameras: dict[str, Camera] = {}
    distortions: dict[str, Distortion] = {}
    files: dict[str, dict[str, dict[int, str]]] = {"image": {}, "mask": {}}
    parts: dict[str, set[tuple[str, int]]] = {_TRAIN: set(), _TEST: set(), _NEITHER: set()}
    for image, (name, frame) in zip(images, places(images, subject=f"capture {root}"), strict=True):
        camera = replace(image.camera, name=name)
        # The first frame fixes the camera; all others must agree with it.
        known = cameras.setdefault(name, camera)
        if not same_camera(known, camera):
            raise InputError(
                f"file {image.source}: camera {name}",
                expected="the pose and intrinsics it has in the other frames",
                received="others",
                remedy="cameras of a capture are static: give moving cameras different names",
            )
        if image.lens is not None:
            distortions[name] = image.lens
        # A missing image leaves a gap in its camera, while its pose stays known.
        if not image.exists:
            problems.append(Problem(f"{root / image.path}: named in {image.source.name}, but missing", name, frame))
            continue
        files["image"].setdefault(name, {})[frame] = str(image.path)
        if image.mask is not None:
            files["mask"].setdefault(name, {})[frame] = str(image.mask)
        parts[image.part].add((name, frame))
    series = {
        kind: {name: FileSeries.from_names(root, names) for name, names in by_camera.items()}
        for kind, by_camera in files.items()
    }
    # Images with an alpha channel carry their mask themselves (Blender's scenes).
    if not series["mask"] and _has_alpha(series["image"]):
        series["mask"] = series["image"]
    return Recording(
        name=root.name,
        root=root,
        format=NAME,
        cameras=cameras,
        distortions=distortions,
        files={kind: by_camera for kind, by_camera in series.items() if by_camera or kind == "image"},
        splits=_splits(cameras, parts),
        params=chosen_params(options),
        problems=tuple(problems),
    )


def _transform_files(root: Path) -> list[Path]:
    return [path for folder in _SETS for path in sorted((root / folder).glob("transform*.json"))]


def _images(root: Path, path: Path, content: Mapping[str, Any], problems: list[Problem]) -> list[NamedImage]:
    """Return the images of one file; images of unknown size are reported in `problems` and left out."""
    found = []
    frame = _frame_of(path)
    listed = _listed_parts(root, path, content)
    # A file or folder of test or val holds out its images; nerfstudio's lists overrule this.
    default = _TEST if {path.parent.name, path.stem.rpartition("_")[2]} & set(_HELD_OUT) else _TRAIN
    for index, entry in enumerate(as_list(required(content, "frames", source=f"file {path}"), subject=f"file {path}")):
        source = f"file {path}: frame {index}"
        name = as_text(required(as_object(entry, subject=source), "file_path", source=source), subject=source)
        source = f"file {path}: {name[:200]}"
        image = find_image(root, path.parent, name, subject=source)
        try:
            # Values of the frame overrule those of the file.
            size = _size(root / image, {**content, **entry})
        except InputError as error:
            problems.append(Problem(str(error)))
            continue
        camera, lens = frame_camera(content, entry, size, name=image.name, source=source)
        mask = mask_beside(root, image)
        if entry.get("mask_path") is not None:
            mask = find_image(root, path.parent, as_text(entry["mask_path"], subject=source), subject=source)
        if mask is not None and not os.path.isfile(root / mask):
            mask = None
        time = None if entry.get("time") is None else as_number(entry["time"], subject=f"{source}: time")
        part = default if listed is None else listed.get(str(image), _NEITHER)
        exists = os.path.isfile(root / image)
        found.append(NamedImage(image, exists, mask, camera, lens, frame, time, part, path))
    return found


def _frame_of(path: Path) -> int | None:
    """Return the number at the end of a file name, which is the frame of all its images; None without one."""
    match = re.search(r"_([0-9]+)$", path.stem)
    max_digits = 18  # those of an int64
    if match is not None and len(match[1]) > max_digits:
        raise InputError(f"file {path}", expected=f"a number of at most {max_digits} digits", received=match[1][:80])
    return None if match is None else int(match[1])


def _size(path: Path, values: Mapping[str, Any]) -> tuple[Any, Any]:
    return (values["w"], values["h"]) if "w" in values and "h" in values else image_size(path)


def _listed_parts(root: Path, path: Path, content: Mapping[str, Any]) -> dict[str, str] | None:
    """Return the split of images by nerfstudio's `train_`, `val_` and `test_filenames`; None without these lists."""
    lists = {part: content.get(f"{part}_filenames") for part in (*_HELD_OUT, _TRAIN)}
    if all(names is None for names in lists.values()):
        return None
    parts = {}
    for part, names in lists.items():
        subject = f"file {path}: {part}_filenames"
        for name in as_list(names or [], subject=subject):
            image = find_image(root, path.parent, as_text(name, subject=subject), subject=subject)
            parts[str(image)] = _TRAIN if part == _TRAIN else _TEST
    return parts


def _scale_note(path: Path, content: Mapping[str, Any]) -> list[Problem]:
    """Report a scale that a tool applied to the world, which is not undone."""
    scale = content.get("applied_scale")
    if scale is None or as_number(scale, subject=f"file {path}: applied_scale") == 1:
        return []
    return [Problem(f"{path}: applied_scale {scale:g}, a factor of the world: left aside")]


def _dynamic_masks(root: Path, images: Sequence[NamedImage]) -> list[Problem]:
    """Report Instant-NGP's `dynamic_mask_IMAGE.png`, which mark pixels that its training skips and are not read."""
    first = {image.path.parent: image.path for image in images}
    found = [path.with_name(f"dynamic_mask_{path.stem}.png") for path in first.values()]
    folders = [str(root / path.parent) for path in found if os.path.isfile(root / path)]
    return [Problem(f"{', '.join(folders[:5])}: dynamic_mask_*.png: left aside")] if folders else []


def _has_alpha(images: Mapping[str, FileSeries]) -> bool:
    """Tell whether the first readable image has an alpha channel, which is then assumed for all."""
    for series in images.values():
        try:
            return image_mode(series.required(int(series.numbers[0]))) in ("RGBA", "LA", "PA")
        except InputError:  # `find_problems` reports it
            continue
    return False


def _splits(cameras: Mapping[str, Camera], parts: Mapping[str, set[tuple[str, int]]]) -> Splits | None:
    """Hold out the cameras and frames that only test and val name; None without any training image."""
    if not parts[_TRAIN]:
        return None
    # Both sets of each axis; what training and test share is trained on, or nothing would be left to train.
    train_cameras, test_cameras = ({name for name, _ in parts[part]} for part in (_TRAIN, _TEST))
    train_frames, test_frames = ({frame for _, frame in parts[part]} for part in (_TRAIN, _TEST))
    return Splits(
        tuple(name for name in cameras if name in train_cameras),
        tuple(name for name in cameras if name in test_cameras - train_cameras),
        tuple(sorted(train_frames)),
        tuple(sorted(test_frames - train_frames)),
    )
