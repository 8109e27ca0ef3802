"""COLMAP's cameras and images, from text or binary files."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from smplxpp.core.errors import InputError

T = TypeVar("T")

# Name, number of parameters, in the order of COLMAP's model ids.
MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
)


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics: the model's name, the size and its parameters, pixel centres at +0.5."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def intrinsics(self, *, source: str) -> tuple[Float64[np.ndarray, "3 3"], list[float]]:
        """K (3, 3), and the distortion in OpenCV's order.

        Raises:
            InputError: a model that is not a pinhole with OpenCV's distortion.
        """
        p = self.params
        single = self.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
        K = np.diag([p[0], p[0] if single else p[1], 1.0])
        K[:2, 2] = p[1:3] if single else p[2:4]
        rest = list(p[3:] if single else p[4:])
        if self.model in ("SIMPLE_PINHOLE", "PINHOLE"):
            return K, []
        if self.model in ("SIMPLE_RADIAL", "RADIAL"):
            return K, [*rest, *[0.0] * (4 - len(rest))]
        if self.model in ("OPENCV", "FULL_OPENCV"):
            return K, rest
        raise InputError(
            source,
            expected=f"one of {', '.join(name for name, _ in MODELS if 'FISHEYE' not in name)}",
            received=self.model,
            remedy="undistort with `colmap image_undistorter` and open its result",
        )


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image: `x_cam = R x_world + t`, its camera's id, its path below the image folder."""

    R: Float64[np.ndarray, "3 3"]
    t: Float64[np.ndarray, " 3"]
    camera: int
    name: str


def model_folder(root: Path) -> Path | None:
    """The folder of the model: `sparse/0`, `sparse` or the folder itself."""
    for folder in (root / "sparse" / "0", root / "sparse", root):
        if any((folder / f"cameras.{s}").is_file() and (folder / f"images.{s}").is_file() for s in ("bin", "txt")):
            return folder
    return None


def read_model(folder: Path) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
    """Cameras by id, and images; the binary files where both kinds are there.

    Raises:
        InputError: a truncated or foreign file, an unknown camera model.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    suffix = "bin" if binary else "txt"
    cameras = _read_table(_cameras_bin if binary else _cameras_txt, folder / f"cameras.{suffix}")
    return cameras, _read_table(_images_bin if binary else _images_txt, folder / f"images.{suffix}")


def _read_table(reader: Callable[[Path], T], path: Path) -> T:
    try:
        return reader(path)
    except InputError:
        raise
    except (ValueError, IndexError, OverflowError, struct.error, OSError) as error:
        raise InputError(
            f"file {path}",
            expected=f"COLMAP's {path.stem} as {path.suffix[1:]}",
            received=f"{type(error).__name__}: {error}",
        ) from None


def _image(quaternion: list[float], t: list[float], camera: int, name: str) -> ColmapImage:
    w, x, y, z = quaternion
    return ColmapImage(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(t), camera, name)


def _cameras_txt(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for line in path.read_text().splitlines():
        if line.strip() and not line.startswith("#"):
            number, model, width, height, *params = line.split()
            if model not in dict(MODELS) or len(params) != dict(MODELS)[model]:
                raise ValueError(f"camera {number} of model {model} with {len(params)} parameters")
            cameras[int(number)] = ColmapCamera(model, int(width), int(height), tuple(map(float, params)))
    return cameras


def _images_txt(path: Path) -> list[ColmapImage]:
    # Two lines an image; the second, its points, may be empty.
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    images = []
    for line in lines[::2]:
        if not line.strip():
            continue
        fields = line.split(maxsplit=9)
        images.append(
            _image([float(f) for f in fields[1:5]], [float(f) for f in fields[5:8]], int(fields[8]), fields[9].strip())
        )
    return images


def _cameras_bin(path: Path) -> dict[int, ColmapCamera]:
    data = path.read_bytes()
    (count,), at, cameras = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        if not 0 <= model < len(MODELS):
            raise ValueError(f"camera {number} of unknown model {model}")
        name, parameters = MODELS[model]
        cameras[number] = ColmapCamera(name, width, height, struct.unpack_from(f"<{parameters}d", data, at + 24))
        at += 24 + 8 * parameters
    return cameras


def _images_bin(path: Path) -> list[ColmapImage]:
    data = path.read_bytes()
    (count,), at, images = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        values = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        images.append(_image(list(values[1:5]), list(values[5:8]), values[8], data[at + 64 : end].decode()))
        at = end + 9 + 24 * points
    return images
