"""Read 4D-Dress (Wang et al. 2024): `Capture/cameras.pkl`, `Capture/CAM/{images,masks}`, `Meshes_pkl/`, `SMPLX/`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from smplxpp.capture.files import FileSeries, image_name
from smplxpp.capture.readers.common import ReaderOptions, chosen_params, pinhole, required, size_of_first_image
from smplxpp.capture.recording import Problem, Recording
from smplxpp.capture.sources import MeshFiles, ParamFiles
from smplxpp.core import Camera, InputError
from smplxpp.core.files.json_file import as_numbers
from smplxpp.core.files.safe_pickle import safe_load

NAME = "4ddress"
LOOKS_FOR = "Capture/cameras.pkl beside Meshes_pkl/"


def detect(root: Path) -> bool:
    """Tell whether a folder is a take."""
    return (root / "Capture" / "cameras.pkl").is_file()


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find the files of a take: photographs with rendered masks, scans as true meshes, SMPL-X fits.

    No pickle is executed. `intrinsics` and `extrinsics` (3, 4) in the file follow OpenCV; the authors' loader negates
    the first two rows for the axes of PyTorch3D (x left, y up). Pixel centres are at +0.5, like those of the rendered
    masks.

    Raises:
        InputError: a broken camera file.
    """
    path = root / "Capture" / "cameras.pkl"
    content = safe_load(path)
    if not isinstance(content, Mapping):
        raise InputError(f"file {path}", expected="a dictionary of cameras", received=type(content).__name__)
    files = {
        kind: {
            str(name): FileSeries.find(root / "Capture" / str(name) / folder, image_name(before)) for name in content
        }
        for kind, folder, before in (("image", "images", "capture-f"), ("mask", "masks", "mask-f"))
    }
    files = {kind: {name: s for name, s in series.items() if len(s)} for kind, series in files.items()}
    # More cameras were calibrated than released; the image size of the others is unknown.
    released = {str(name): entry for name, entry in content.items() if str(name) in files["image"]}
    # Meshes and fits are pickles, which `safe_load` reads without executing them.
    meshes = FileSeries.find(root / "Meshes_pkl", r"mesh-f(?P<frame>\d+)\.pkl")
    fits = FileSeries.find(root / "SMPLX", r"mesh-f(?P<frame>\d+)_smplx\.pkl")
    fitted = ParamFiles(fits, "smplx", options.body) if len(fits) else None
    return Recording(
        name="_".join(root.resolve().parts[-3:]),
        root=root,
        format=NAME,
        cameras={name: _camera(name, entry, path, files["image"]) for name, entry in released.items()},
        files=files,
        params=chosen_params(options) or fitted,
        meshes=MeshFiles(meshes),
        problems=tuple(
            Problem(f"camera {name}: calibrated, but without any image", str(name))
            for name in content
            if str(name) not in released
        ),
    )


def _camera(name: str, entry: Mapping, path: Path, images: Mapping[str, FileSeries]) -> Camera:
    source = f"file {path}: camera {name}"
    K = required(entry, "intrinsics", source=source)
    extrinsics = as_numbers(required(entry, "extrinsics", source=source), subject=f"{source}: extrinsics")
    if extrinsics.shape not in ((3, 4), (4, 4)):
        raise InputError(source, expected="extrinsics of shape (3, 4)", received=f"shape {extrinsics.shape}")
    return pinhole(name, K, extrinsics[:3, :3], extrinsics[:3, 3], size_of_first_image(name, images))
