"""The files of one view in a converted capture: copied where nothing changes, else encoded."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from smplxpp.capture import Capture
from smplxpp.capture.window import Window
from smplxpp.capture.writers.images import png16
from smplxpp.core.atomic import atomic_write_bytes
from smplxpp.core.errors import InputError

_LOSSLESS = (".png", ".tif", ".tiff", ".bmp")
_JPEG = (".jpg", ".jpeg")


@dataclass(frozen=True)
class ViewOutcome:
    """Files of one view that were copied, encoded, or there already; or what is wrong with it."""

    copied: int = 0
    encoded: int = 0
    kept: int = 0
    problem: str = ""


@dataclass(frozen=True, eq=False)
class ViewWriter:
    """Writes views of a capture.

    Attributes:
        capture: with the pixels that are wanted.
        root: folder of `rgbs` and the others.
        layout: "simple" or "actorshq" (JPEG on black, PNG masks, nothing else).
        quality: of JPEG.
    """

    capture: Capture
    root: Path
    layout: str
    quality: int

    def write(self, camera: str, frame: int) -> ViewOutcome:
        """All files of a view, or none where one of them cannot be read."""
        targets = self._targets(camera, frame)
        if all(path.is_file() for path, _ in targets.values()):
            return ViewOutcome(kept=len(targets))
        read = {"image": self._image, "mask": self.capture.mask, "label": self.capture.labels, "normal": self._normals}
        contents, copied = {}, 0
        try:
            for kind, (path, same) in targets.items():
                value = read[kind](camera, frame)  # decoded in any case: a damaged file is not passed on
                if same:
                    contents[path] = self.capture.file(camera, frame, kind).read_bytes()
                    copied += 1
                else:
                    contents[path] = self._encoded(value, path.suffix)
        except InputError as error:
            return ViewOutcome(problem=f"camera {camera}, frame {frame} left out: {error}")
        # The image last: a view that has one is whole.
        for path in reversed(contents):
            atomic_write_bytes(path, contents[path])
        return ViewOutcome(copied=copied, encoded=len(contents) - copied)

    def _targets(self, camera: str, frame: int) -> dict[str, tuple[Path, bool]]:
        """For each kind of file its place, and whether the source's bytes can be taken."""
        capture = self.capture
        unchanged = camera not in capture.recording.distortions and capture.windows[camera] == Window.full(
            capture.recording.cameras[camera]
        )
        found = {kind: capture.file(camera, frame, kind) for kind in ("image", "mask", "label", "normal")}
        suffix = found["image"].suffix.lower()

        def place(folder: str, tag: str, ending: str) -> Path:
            return self.root / folder / camera / f"{camera}_{tag}{frame:06d}{ending}"

        if self.layout == "actorshq":
            on_black = capture.recording.background == (0.0, 0.0, 0.0)
            same = unchanged and on_black and suffix == ".jpg"
            return {
                "image": (place("rgbs", "rgb", ".jpg"), same),
                "mask": (place("masks", "mask", ".png"), unchanged and _is_plain_mask(found["mask"])),
            }
        kept = suffix if unchanged or suffix in _JPEG else (".png" if suffix in _LOSSLESS else ".jpg")
        targets = {"image": (place("rgbs", "rgb", kept), unchanged)}
        if found["mask"] is not None:
            targets["mask"] = (place("masks", "mask", ".png"), unchanged and _is_plain_mask(found["mask"]))
        for kind, folder in (("label", "labels"), ("normal", "normals")):
            if found[kind] is not None:
                ending = found[kind].suffix.lower() if unchanged else ".png"
                targets[kind] = (place(folder, kind, ending), unchanged)
        return targets

    def _image(self, camera: str, frame: int) -> np.ndarray:
        if self.layout == "actorshq":
            return self.capture.foreground(camera, frame)[0]
        return self.capture.image(camera, frame)

    def _normals(self, camera: str, frame: int) -> np.ndarray:
        """(H, W, 3) uint16 codes, n = value / 65535 * 2 - 1, black outside."""
        normals = self.capture.normals(camera, frame)
        codes = np.clip(np.round((normals + 1.0) * 32767.5), 1, 65535)
        return np.where(normals.any(axis=2, keepdims=True), codes, 0).astype(np.uint16)

    def _encoded(self, image: np.ndarray, suffix: str) -> bytes:
        if image.dtype == np.uint16:
            return png16(image)
        buffer = io.BytesIO()
        if suffix in _JPEG:
            Image.fromarray(image).save(buffer, "JPEG", quality=self.quality, subsampling=0)
        else:
            Image.fromarray(image).save(buffer, "PNG")
        return buffer.getvalue()


def _is_plain_mask(path: Path | None) -> bool:
    """Whether a mask's file is a PNG of 8-bit grey; others (mattes in alpha channels, JPEG) are written anew."""
    if path is None or path.suffix.lower() != ".png":
        return False
    try:
        with Image.open(path) as image:
            return image.mode == "L"
    except (OSError, SyntaxError):
        return False  # told when it is decoded
