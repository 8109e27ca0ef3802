"""Read THuman4.0 (Zheng et al. 2022): `calibration.json`, `images/camNN/00000000.jpg`, `masks/camNN/00000000.jpg`."""

from __future__ import annotations

from pathlib import Path

from smplxpp.capture.readers.avatarrex import read_calibration
from smplxpp.capture.readers.common import ReaderOptions, chosen_params, numbered_images
from smplxpp.capture.recording import Recording

NAME = "thuman4"
LOOKS_FOR = "calibration.json beside images/camNN/"


def detect(root: Path) -> bool:
    """Tell whether a folder is a subject of THuman4.0."""
    return (root / "calibration.json").is_file() and any(root.glob("images/cam[0-9][0-9]"))


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find the files of a subject: photographs, masks, `smpl_params.npz` with a row for each frame.

    Raises:
        InputError: a broken calibration.
    """
    cameras, distortions = read_calibration(root / "calibration.json")
    return Recording(
        name=root.name,
        root=root,
        format=NAME,
        cameras=cameras,
        distortions=distortions,
        files={
            "image": numbered_images({name: root / "images" / name for name in cameras}),
            "mask": numbered_images({name: root / "masks" / name for name in cameras}),
        },
        params=chosen_params(options, root / "smpl_params.npz"),
    )
