"""COLMAP (Schoenberger and Frahm 2016): `sparse/0/{cameras,images}.{bin,txt}`, `images/`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import FileSeries, image_name
from smplxpp.capture.readers.colmap_model import ColmapImage, model_folder, read_model
from smplxpp.capture.readers.common import chosen_params, pinhole
from smplxpp.capture.readers.options import ReaderOptions
from smplxpp.capture.recording import Recording
from smplxpp.core.errors import InputError

NAME = "colmap"
LOOKS_FOR = "cameras and images as .bin or .txt, in sparse/0, sparse or there"


def detect(root: Path) -> bool:
    """Tell whether a folder holds a model."""
    return model_folder(root) is not None


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find a reconstruction. Its world has no metre and no upright unless the user gave it both beforehand.

    COLMAP reconstructs a rigid scene. If every folder of images has one registered image, the folder is a camera of a
    fixed rig and its numbered files are the frames; otherwise every registered image is a camera and all show frame 0.
    Masks are `masks/NAME.png` (NAME with its suffix, as for COLMAP itself) or `masks/` with the same names.

    Raises:
        InputError: a broken model, a fisheye camera.
    """
    folder = model_folder(root)
    if folder is None:
        raise InputError(f"capture {root}", expected=LOOKS_FOR, received="none")
    lenses, images = read_model(folder)
    rig = _is_rig(images)
    cameras, distortions = {}, {}
    files: dict[str, dict[str, FileSeries]] = {"image": {}, "mask": {}}
    for image in images:
        path = PurePosixPath(image.name)
        name = path.parent.name if rig else "_".join([*path.parent.parts, path.stem])
        source = f"file {folder}: image {image.name}"
        if image.camera not in lenses:
            raise InputError(source, expected=f"a camera among {sorted(lenses)}", received=str(image.camera))
        lens = lenses[image.camera]
        K, coefficients = lens.intrinsics(source=source)
        cameras[name] = pinhole(name, K, image.R, image.t, (lens.width, lens.height))
        distortion = Distortion.from_opencv(coefficients, subject=source)
        if distortion is not None:
            distortions[name] = distortion
        if rig:
            files["image"][name] = FileSeries.find(root / "images" / path.parent, image_name())
            masks = image_name(after=r"(?:\.\w+)?")
            files["mask"][name] = FileSeries.find(root / "masks" / path.parent, masks)
        else:
            files["image"][name] = _single(root / "images", [image.name])
            files["mask"][name] = _single(
                root / "masks", [f"{image.name}.png", image.name, str(path.with_suffix(".png"))]
            )
    return Recording(
        name=root.resolve().name,
        root=root,
        format=NAME,
        cameras=dict(sorted(cameras.items())),
        distortions=distortions,
        files={kind: {name: s for name, s in series.items() if len(s)} for kind, series in files.items()},
        params=chosen_params(options),
    )


def _is_rig(images: Sequence[ColmapImage]) -> bool:
    folders = Counter(PurePosixPath(image.name).parent.name for image in images)
    numbered = all(PurePosixPath(image.name).stem.isdigit() for image in images)
    return numbered and "" not in folders and max(folders.values(), default=0) == 1


def _single(folder: Path, names: Sequence[str]) -> FileSeries:
    found = next((name for name in names if (folder / name).is_file()), None)
    return FileSeries.from_names(folder, {} if found is None else {0: found})
