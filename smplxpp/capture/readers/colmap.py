"""Read COLMAP (Schoenberger and Frahm 2016): `sparse/0/{cameras,images}.{bin,txt}`, `images/`."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from smplxpp.capture.files import FileSeries, image_name
from smplxpp.capture.readers.colmap_model import ColmapImage, model_folder, read_model
from smplxpp.capture.readers.common import ReaderOptions, camera_names, chosen_params, number_at_end, pinhole
from smplxpp.capture.recording import Recording
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import path_inside

NAME = "colmap"
LOOKS_FOR = "cameras and images as .bin or .txt, in sparse/0, sparse or there"


def detect(root: Path) -> bool:
    """Tell whether a folder holds a model."""
    return model_folder(root) is not None


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find the files of a reconstruction, whose scale and up axis are arbitrary unless the user aligned it.

    COLMAP reconstructs a rigid scene. If every folder of images has one registered image, the folder is a camera of a
    fixed rig and its numbered files are the frames. Otherwise every registered image is a camera, and all show frame 0.
    Masks are `masks/NAME.png` (NAME with its suffix, as for COLMAP itself) or `masks/` with the same names.

    Raises:
        InputError: a broken model, an unsupported camera model, images outside of `images/`.
    """
    folder = model_folder(root)
    if folder is None:
        raise InputError(f"capture {root}", expected=LOOKS_FOR, received="none")
    lenses, images = read_model(folder)
    paths = [_path_of(root, image, folder) for image in images]
    rig = _is_rig(paths)
    names = camera_names((path.parent if rig else path for path in paths), subject=f"file {folder}")
    # A camera for each registered image, with its own files or, in a rig, those of its folder.
    cameras, distortions = {}, {}
    files: dict[str, dict[str, FileSeries]] = {"image": {}, "mask": {}}
    for image, path in zip(images, paths, strict=True):
        name = names[path.parent if rig else path]
        source = f"file {folder}: image {path}"
        if image.camera not in lenses:
            raise InputError(source, expected=f"a camera among {sorted(lenses)[:20]}", received=str(image.camera))
        lens = lenses[image.camera]
        K, distortion = lens.intrinsics(source=source)
        cameras[name] = pinhole(name, K, image.R, image.t, (lens.width, lens.height))
        if distortion is not None:
            distortions[name] = distortion
        if rig:
            files["image"][name] = FileSeries.find(root / "images" / path.parent, image_name())
            masks = image_name(after=r"(?:\.\w+)?")
            files["mask"][name] = FileSeries.find(root / "masks" / path.parent, masks)
        else:
            files["image"][name] = _single(root / "images", [str(path)])
            files["mask"][name] = _single(root / "masks", [f"{path}.png", str(path), str(path.with_suffix(".png"))])
    return Recording(
        name=root.resolve().name,
        root=root,
        format=NAME,
        cameras=dict(sorted(cameras.items())),
        distortions=distortions,
        files={kind: {name: s for name, s in series.items() if len(s)} for kind, series in files.items()},
        params=chosen_params(options),
    )


def _path_of(root: Path, image: ColmapImage, folder: Path) -> PurePosixPath:
    """Return the path of an image below `images/`, refusing names that leave the folder."""
    inside = path_inside(root / "images", image.name, subject=f"file {folder}: name of an image")
    return PurePosixPath(inside.relative_to(os.path.normpath(root / "images")))


def _is_rig(paths: Sequence[PurePosixPath]) -> bool:
    """Tell whether each image is the only one of its folder and its name is a number."""
    folders = Counter(path.parent for path in paths)
    numbered = all((number_at_end(path) or ("?", 0))[0] == "" for path in paths)
    return numbered and PurePosixPath() not in folders and max(folders.values(), default=0) == 1


def _single(folder: Path, names: Sequence[str]) -> FileSeries:
    """Return the first existing file as frame 0; an empty series without any."""
    found = next((name for name in names if os.path.isfile(folder / name)), None)
    return FileSeries.from_names(folder, {} if found is None else {0: found})
