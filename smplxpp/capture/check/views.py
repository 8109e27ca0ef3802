"""One view: its files opened, its mask looked at, the body's silhouette held against it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Int16, UInt8
from scipy import ndimage

from smplxpp.capture import Capture
from smplxpp.capture.check.findings import Finding, unreadable_finding
from smplxpp.capture.check.silhouettes import MIN_SHARE, SilhouetteFit, body_silhouette, compare_silhouettes
from smplxpp.core.errors import InputError

OPAQUE = 127
_FULL = 0.995
# A mask is inverted if the body is this much outside of it and overlaps this much with the rest of the image.
_INVERTED_OUTSIDE, _INVERTED_IOU = 0.7, 0.5
# Without a body: opaque at this share of the image's rim, less within.
_INVERTED_RIM = 0.6
# Of 255. The median of what lies outside the mask may differ this much from the declared colour (JPEG's is about 1);
# a pixel that differs by more than the second shows something.
_BACKGROUND_TOLERANCE, _SHOWS_SOMETHING = 16, 48
# Area outside the mask that shows something, as a share of the mask's.
_MISMATCH = 0.05
# Photographs whose 95th percentile outside the mask is within this of their median are on a plain colour: no lens and
# no wall is that even, JPEG of one colour is.
_PLAIN = 2
# Pixels about the mask that do not count: the soft edge, and JPEG's ringing.
_EDGE = 3
_STEP = 2


@dataclass(frozen=True)
class ViewCheck:
    """What one view shows.

    Attributes:
        mask_share: share of the image that the mask covers; None without a usable mask.
        fit: None without a body, without a usable mask, or where there is nobody.
        plain: the plain colour that a photograph is on, else None.
    """

    camera: str
    frame: int
    findings: tuple[Finding, ...] = ()
    mask_share: float | None = None
    fit: SilhouetteFit | None = None
    plain: tuple[int, int, int] | None = None


def check_view(
    capture: Capture,
    camera: str,
    frame: int,
    body: tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]] | None,
) -> ViewCheck:
    """Open everything of one view.

    Args:
        capture: at the size at which silhouettes are compared.
        camera, frame: with an image.
        body: vertices and faces of the posed body; None where there are no parameters.
    """
    reader = capture.reader(camera)
    findings: list[Finding] = []

    def opened(kind: str, read: Callable[[Path], np.ndarray]) -> np.ndarray | None:
        path = capture.file(camera, frame, kind)
        if path is None:
            return None
        try:
            return read(path)
        except InputError as error:
            findings.append(unreadable_finding(error, camera, frame))
            return None

    image = opened("image", reader.color)
    alpha = opened("mask", reader.alpha)
    opened("label", reader.labels)
    opened("normal", reader.normals)
    if alpha is None:
        return ViewCheck(camera, frame, tuple(findings))
    mask = alpha > OPAQUE
    silhouette = None if body is None else body_silhouette(*body, capture.cameras[camera])
    wrong = _wrong_mask(mask, silhouette)
    if wrong is not None:
        kind, words = wrong
        path = capture.file(camera, frame, "mask")
        return ViewCheck(camera, frame, (*findings, Finding(kind, f"mask {path}: {words}", camera, frame)), mask.mean())
    plain = None
    if image is not None:
        name = f"image {capture.file(camera, frame)}"
        background = capture.recording.background
        if background is None:
            plain = _plain_colour(image, alpha)
        else:
            colour = np.asarray(background) * 255.0
            findings += [
                Finding(kind, f"{name}: {words}", camera, frame)
                for kind, words in _against_background(image, alpha, colour)
            ]
    fit = None if silhouette is None else compare_silhouettes(silhouette, mask)
    return ViewCheck(camera, frame, tuple(findings), float(mask.mean()), fit, plain)


def _wrong_mask(mask: Bool[np.ndarray, "H W"], silhouette: Bool[np.ndarray, "H W"] | None) -> tuple[str, str] | None:
    """Return kind and words of a mask that cannot be one of the person, else None."""
    share = float(mask.mean())
    if share > _FULL:
        return "mask-full", f"covers {share:.1%} of the image"
    visible = None if silhouette is None else float(silhouette.mean())
    if share < MIN_SHARE / 10:
        # Without a body nobody can say whether the camera sees the person.
        seen = visible is not None and visible > 2 * MIN_SHARE
        return ("mask-empty", f"is empty, but the body covers {visible:.1%} of the image") if seen else None
    if silhouette is not None and visible is not None and visible > MIN_SHARE:
        fit, inverse = compare_silhouettes(silhouette, mask), compare_silhouettes(silhouette, ~mask)
        assert fit is not None and inverse is not None  # the body is large enough to say something
        inverted = fit.outside > _INVERTED_OUTSIDE and inverse.iou > _INVERTED_IOU
    else:
        rim = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()
        inverted = rim > _INVERTED_RIM and share > 0.5 and rim > share
    return ("mask-inverted", "covers the background, not the person") if inverted else None


def _against_background(
    image: UInt8[np.ndarray, "H W 3"], alpha: UInt8[np.ndarray, "H W"], colour: Float[np.ndarray, " 3"]
) -> Iterator[tuple[str, str]]:
    """Yield kind and words where an image is not on the colour (of 255) outside its mask."""
    outside = _outside(image, alpha)
    if not len(outside):
        return
    found = np.median(outside, axis=0)
    if np.abs(found - colour).max() > _BACKGROUND_TOLERANCE:
        declared = colour.round().astype(int).tolist()
        yield "background", f"RGB {found.astype(int).tolist()} outside the mask, where the capture declares {declared}"
        return
    shown = int((np.abs(outside - colour).max(axis=1) > _SHOWS_SOMETHING).sum()) * _STEP**2
    area = int((alpha > OPAQUE).sum())
    if shown > _MISMATCH * area and shown > MIN_SHARE * alpha.size:
        yield "mask-mismatch", f"shows something outside its mask, {shown / max(area, 1):.0%} of the mask's area"


def _outside(image: UInt8[np.ndarray, "H W 3"], alpha: UInt8[np.ndarray, "H W"]) -> Int16[np.ndarray, "N 3"]:
    """Return the colours well outside the mask, of every `_STEP`-th pixel each way."""
    rows = ndimage.maximum_filter1d(alpha[::_STEP], 1 + 2 * _EDGE, axis=1)[:, ::_STEP]
    near = ndimage.maximum_filter1d(rows, 1 + 2 * (_EDGE // _STEP + 1), axis=0)
    return image[::_STEP, ::_STEP][near == 0].astype(np.int16)


def _plain_colour(image: UInt8[np.ndarray, "H W 3"], alpha: UInt8[np.ndarray, "H W"]) -> tuple[int, int, int] | None:
    """Return the one colour that lies outside the mask, None where there are several."""
    outside = _outside(image, alpha)
    if len(outside) * _STEP**2 < MIN_SHARE * alpha.size:
        return None
    median = np.median(outside, axis=0).astype(int)
    if np.percentile(np.abs(outside - median).max(axis=1), 95) > _PLAIN:
        return None
    return tuple(median.tolist())
