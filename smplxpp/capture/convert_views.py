"""Write the files of one view of a converted capture: copied where nothing changes, else encoded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from smplxpp.capture.capture import Capture
from smplxpp.capture.window import Window
from smplxpp.capture.writers import JPEG_SUFFIXES, encoded_image, normal_codes, view_path
from smplxpp.core.errors import InputError
from smplxpp.core.files import atomic_write_bytes, read_bytes
from smplxpp.core.files.image_file import image_mode

_LOSSLESS = (".png", ".tif", ".tiff", ".bmp")


@dataclass(frozen=True)
class ViewOutcome:
    """Counts of one view's files, or the reason why it was left out.

    Attributes:
        copied: number of files copied without change.
        encoded: number of files encoded.
        kept: number of files that existed already.
        note: reason why the view was left out; "" for one that is written.
    """

    copied: int = 0
    encoded: int = 0
    kept: int = 0
    note: str = ""


@dataclass(frozen=True, eq=False)
class ViewWriter:
    """A writer of a capture's views in one layout.

    Attributes:
        capture: the capture at the wanted resolution.
        root: folder of `rgbs` and the others.
        layout: "simple" or "actorshq" (JPEG on black, PNG masks, nothing else).
        quality: quality of JPEG files.
    """

    capture: Capture
    root: Path
    layout: str
    quality: int

    def write(self, camera: str, frame: int) -> ViewOutcome:
        """Write all files of a view, or none if one of them cannot be read."""
        targets = self._targets(camera, frame)
        if all(path.is_file() for path, _ in targets.values()):
            return ViewOutcome(kept=len(targets))
        read = {"image": self._image, "mask": self.capture.mask, "label": self.capture.labels, "normal": self._normals}
        contents, copied = {}, 0
        try:
            for kind, (path, source) in targets.items():
                value = read[kind](camera, frame)  # decoded in any case, so that no damaged file is copied
                if source is not None:
                    contents[path] = read_bytes(source)
                    copied += 1
                else:
                    assert value is not None  # only existing files have a target
                    contents[path] = encoded_image(value, path.suffix, self.quality)
        except InputError as error:
            return ViewOutcome(note=f"camera {camera}, frame {frame} left out: {error}")
        # The image comes last, so that a view with an image is complete.
        for path in reversed(contents):
            atomic_write_bytes(path, contents[path])
        return ViewOutcome(copied=copied, encoded=len(contents) - copied)

    def _targets(self, camera: str, frame: int) -> dict[str, tuple[Path, Path | None]]:
        """Return for each kind of file its path, and the source's file if its bytes can be copied."""
        # Bytes can be copied only where neither lens nor size changes.
        capture = self.capture
        unchanged = camera not in capture.recording.distortions and capture.windows[camera] == Window.full(
            capture.recording.cameras[camera]
        )
        image, mask = capture.file(camera, frame), capture.file(camera, frame, "mask")
        assert image is not None  # views are those with an image
        suffix = image.suffix.lower()
        mask_source = mask if unchanged and _is_plain_mask(mask) else None

        def target(kind: str, ending: str, source: Path | None) -> tuple[Path, Path | None]:
            return view_path(self.root, kind, camera, frame, ending), source

        if self.layout == "actorshq":
            on_black = capture.recording.background == (0.0, 0.0, 0.0)
            same = unchanged and on_black and suffix == ".jpg"
            # An image without a mask cannot be put on black; reading it raises that error.
            return {
                "image": target("image", ".jpg", image if same else None),
                "mask": target("mask", ".png", mask_source),
            }
        # Other images keep their format if it can be written, lossless ones as PNG.
        kept = suffix if unchanged or suffix in JPEG_SUFFIXES else (".png" if suffix in _LOSSLESS else ".jpg")
        targets = {"image": target("image", kept, image if unchanged else None)}
        if mask is not None:
            targets["mask"] = target("mask", ".png", mask_source)
        for kind in ("label", "normal"):
            found = capture.file(camera, frame, kind)
            if found is not None:
                ending = found.suffix.lower() if unchanged else ".png"
                targets[kind] = target(kind, ending, found if unchanged else None)
        return targets

    def _image(self, camera: str, frame: int) -> UInt8[np.ndarray, "H W 3"]:
        if self.layout == "actorshq":
            return self.capture.foreground(camera, frame)[0]
        return self.capture.image(camera, frame)

    def _normals(self, camera: str, frame: int) -> UInt16[np.ndarray, "H W 3"] | None:
        normals = self.capture.normals(camera, frame)
        return None if normals is None else normal_codes(normals)


def _is_plain_mask(path: Path | None) -> bool:
    """Return whether a mask's file is a PNG of 8-bit grey; others (alpha channels, JPEG) are encoded again."""
    if path is None or path.suffix.lower() != ".png":
        return False
    try:
        return image_mode(path) == "L"
    except InputError:
        return False  # decoding it reports the error
