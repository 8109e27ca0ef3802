"""Read COLMAP (Schoenberger and Frahm 2016): `sparse/0/{cameras,images}.{bin,txt}`, `images/`."""

from __future__ import annotations

import mmap
import os
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from smplxpp.capture.distortion import FISHEYE, FOV, OPENCV, Distortion
from smplxpp.capture.files import IMAGE_SUFFIXES, FileSeries, image_name
from smplxpp.capture.readers.common import ReaderOptions, camera_names, chosen_params, number_at_end, pinhole
from smplxpp.capture.recording import Recording
from smplxpp.core.errors import InputError, warn_of_left_out
from smplxpp.core.files import as_numbers, regular_file
from smplxpp.core.files.paths import ascii_numbers, path_inside

T = TypeVar("T")

# Names and numbers of parameters of the camera models, in the order of COLMAP's ids (src/colmap/sensor/models.h,
# version 4.2).
MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)
# Supported models: number of focal lengths, and the distortion model of the parameters after the principal point.
_SUPPORTED = {
    "SIMPLE_PINHOLE": (1, OPENCV),
    "PINHOLE": (2, OPENCV),
    "SIMPLE_RADIAL": (1, OPENCV),
    "RADIAL": (1, OPENCV),
    "OPENCV": (2, OPENCV),
    "FULL_OPENCV": (2, OPENCV),
    "FOV": (2, FOV),
    "OPENCV_FISHEYE": (2, FISHEYE),
    "SIMPLE_RADIAL_FISHEYE": (1, FISHEYE),
    "RADIAL_FISHEYE": (1, FISHEYE),
    "SIMPLE_FISHEYE": (1, FISHEYE),
    "FISHEYE": (2, FISHEYE),
}
_REMEDY = "undistort with `colmap image_undistorter` and open its result"


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics of a camera: name of the model, image size and parameters, pixel centres at +0.5."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def intrinsics(self, *, source: str) -> tuple[Float64[np.ndarray, "3 3"], Distortion | None]:
        """Return K (3, 3) and the distortion, None for a pinhole.

        Raises:
            InputError: an unsupported model, or parameters that are not numbers.
        """
        if self.model not in _SUPPORTED:
            raise InputError(
                f"{source}: camera model",
                expected=f"one of {', '.join(_SUPPORTED)}",
                received=self.model,
                remedy=_REMEDY,
            )
        p = as_numbers(self.params, (None,), subject=f"{source}: camera parameters").tolist()
        focal_lengths, model = _SUPPORTED[self.model]
        # Models with one focal length use it for both axes: p = (f, cx, cy, ...) or (fx, fy, cx, cy, ...).
        K = np.diag([p[0], p[focal_lengths - 1], 1.0])
        K[:2, 2] = p[focal_lengths : focal_lengths + 2]
        lens = p[focal_lengths + 2 :]
        # OpenCV's models need four coefficients; COLMAP's shorter models leave the last ones out, which are zero.
        if model != FOV:
            lens += [0.0] * (4 - len(lens))
        return K, Distortion.from_opencv(lens, subject=source, model=model)


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image: pose `x_cam = R x_world + t`, id of the camera, path below the image folder."""

    R: Float64[np.ndarray, "3 3"]
    t: Float64[np.ndarray, " 3"]
    camera: int
    name: str


def model_folder(root: Path) -> Path | None:
    """Return the folder of the model (`sparse/0`, `sparse` or the folder itself); None without one."""
    for folder in (root / "sparse" / "0", root / "sparse", root):
        if _is_model(folder):
            return folder
    return None


def _is_model(folder: Path) -> bool:
    return any((folder / f"cameras.{s}").is_file() and (folder / f"images.{s}").is_file() for s in ("bin", "txt"))


def read_model(folder: Path) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
    """Read cameras by id, and images, from the binary files if both exist, else from the text files.

    `images` contains complete poses; `rigs` and `frames` of COLMAP 3.12 and later repeat them in factors.

    Raises:
        InputError: a truncated or foreign file, an unknown camera model.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    suffix = "bin" if binary else "txt"
    cameras = _read_table(_cameras_bin if binary else _cameras_txt, folder / f"cameras.{suffix}")
    return cameras, _read_table(_images_bin if binary else _images_txt, folder / f"images.{suffix}")


def _read_table(reader: Callable[[Path], T], path: Path) -> T:
    """Call a reader, and convert its exceptions on damaged files into an InputError."""
    try:
        return reader(regular_file(path))
    except InputError:
        raise
    except (ValueError, IndexError, OverflowError, struct.error, OSError) as error:
        raise InputError(
            f"file {path}",
            expected=f"COLMAP's {path.stem} as {path.suffix[1:]}",
            received=f"{type(error).__name__}: {error}"[:200],
        ) from None


def _image(path: Path, numbers: list[float], camera: int, name: str) -> ColmapImage:
    w, x, y, z, *t = as_numbers(numbers, (7,), subject=f"file {path}: pose of image {name!r}").tolist()
    return ColmapImage(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(t), camera, name)


def _unknown(path: Path, model: str) -> InputError:
    known = ", ".join(name for name, _ in MODELS)
    return InputError(f"file {path}: camera model", expected=f"one of {known}", received=model, remedy=_REMEDY)


def _cameras_txt(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    with path.open(encoding="utf-8") as file:
        for line in file:
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            # CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]
            number, model, width, height, *params = line.split()
            ascii_numbers(" ".join((number, width, height, *params)))
            if model not in dict(MODELS):
                raise _unknown(path, model[:80])
            if len(params) != dict(MODELS)[model]:
                raise ValueError(f"camera {number} of model {model} with {len(params)} parameters")
            cameras[int(number)] = ColmapCamera(model, int(width), int(height), tuple(map(float, params)))
    return cameras


def _images_txt(path: Path) -> list[ColmapImage]:
    images = []
    with path.open(encoding="utf-8") as file:
        for line in file:
            # IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; the name may contain spaces, hence at most nine splits.
            fields = line.split(maxsplit=9)
            if not fields or fields[0].startswith("#"):
                continue
            ascii_numbers(" ".join(fields[:9]))
            images.append(_image(path, [float(f) for f in fields[1:8]], int(fields[8]), fields[9].strip()))
            next(file, "")  # the line of the image's points, which may be empty
    return images


def _cameras_bin(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        (count,), at = struct.unpack_from("<Q", data), 8
        for _ in range(count):
            # camera id (uint32), model id (int32), width and height (uint64): 24 bytes, then the parameters as
            # doubles; little-endian without padding.
            number, model, width, height = struct.unpack_from("<IiQQ", data, at)
            if not 0 <= model < len(MODELS):
                raise _unknown(path, f"number {model}")
            name, parameters = MODELS[model]
            cameras[number] = ColmapCamera(name, width, height, struct.unpack_from(f"<{parameters}d", data, at + 24))
            at += 24 + 8 * parameters
    return cameras


def _images_bin(path: Path) -> list[ColmapImage]:
    images = []
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        (count,), at = struct.unpack_from("<Q", data), 8
        for _ in range(count):
            # Id, quaternion, translation, camera, name ending in NUL, number of points, 24 bytes for each point.
            values = struct.unpack_from("<I7dI", data, at)
            # 64 bytes precede the name: 4 of the id, 56 of seven doubles, 4 of the camera's id. The bound keeps a
            # damaged file from being searched to its end.
            end = data.find(b"\0", at + 64, at + 64 + 4096)
            if end < 0:
                raise ValueError(f"image {values[0]} without the end of its name")
            (points,) = struct.unpack_from("<Q", data, end + 1)
            images.append(_image(path, list(values[1:8]), values[8], data[at + 64 : end].decode()))
            # NUL and the count of points (9 bytes), then x, y and the id of each point (24 bytes).
            at = end + 9 + 24 * points
            if at > len(data):
                raise ValueError(f"{points} points of image {values[0]} past the end of the file")
    return images


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
    _name_left_out(root, folder, paths, rig=rig)
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


def _name_left_out(root: Path, folder: Path, paths: Sequence[PurePosixPath], *, rig: bool) -> None:
    """Name other models of the reconstruction, and images that this one does not register."""
    models = sorted(one.name for one in (root / "sparse").glob("*") if one != folder and _is_model(one))
    warn_of_left_out(f"capture {root}", models, reason=f"models that are not taken beside {folder.name}", stacklevel=3)
    known = {path.parent if rig else path for path in paths}
    images = root / "images"
    found = (PurePosixPath(path.relative_to(images)) for path in images.rglob("*") if _is_image(path))
    others = sorted(str(path) for path in found if (path.parent if rig else path) not in known)
    warn_of_left_out(f"capture {root}", others, reason=f"{len(others)} images that no camera registers", stacklevel=3)


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()


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
