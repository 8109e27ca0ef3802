"""Check one view: open its files, test its mask, and compare the mask with the body's silhouette."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Int16, UInt8
from scipy import ndimage

from smplxpp.capture import Capture
from smplxpp.capture.check.findings import Finding, unreadable_finding
from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError
from smplxpp.core.files.image_file import image_orientation, image_size
from smplxpp.raster import rasterize_triangles

Verdict = Literal["good", "doubtful", "bad"]
# Share of the body's pixels outside of the mask. Exact parameters give up to 0.4 %, a tracker that is 26 mm off on
# average 2 to 10 % in most views.
OUTSIDE_DOUBTFUL, OUTSIDE_BAD = 0.03, 0.15
# Clothes and hair make the mask larger than the body: trousers leave 0.8, a wide skirt 0.6.
IOU_BAD = 0.35
# Silhouettes below this share of the image say nothing.
MIN_SHARE = 1e-3
OPAQUE = 127
"""Opacity, of 255, above which a pixel of a mask counts as the person."""
# Of 255. The median of what lies outside the mask may differ this much from the declared colour (JPEG's is about 1);
# a pixel that differs by more than the second shows something.
_BACKGROUND_TOLERANCE, _SHOWS_SOMETHING = 16, 48
# A photograph is on a plain colour if the 95th percentile of the difference from the median colour outside the mask
# is at most this, of 255. Lenses and walls vary more, a JPEG of one colour does not.
_PLAIN = 2
# Pixels around the mask that are ignored (soft edge, ringing of JPEG), and the sampling step in pixels.
_EDGE, _STEP = 3, 2


@dataclass(frozen=True)
class SilhouetteFit:
    """Body against mask in one view.

    Attributes:
        outside: share of the body's pixels that the mask leaves out; 1 where the body is out of the picture.
        iou: intersection over union.
    """

    outside: float
    iou: float

    @property
    def verdict(self) -> Verdict:
        """Return the verdict that follows from the figures."""
        if self.outside > OUTSIDE_BAD or self.iou < IOU_BAD:
            return "bad"
        return "doubtful" if self.outside > OUTSIDE_DOUBTFUL else "good"


@dataclass(frozen=True)
class FitSummary:
    """Many views: medians, the worst share outside, and how many are bad."""

    views: int
    outside: float
    worst: float
    iou: float
    bad: int

    @property
    def verdict(self) -> Verdict:
        """What the figures of one view with these medians would say."""
        return SilhouetteFit(self.outside, self.iou).verdict


def body_silhouette(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], camera: Camera
) -> Bool[np.ndarray, "H W"]:
    """Return the pixels whose centres the body covers."""
    return rasterize_triangles(vertices, faces, camera, threads=1).mask


def compare_silhouettes(body: Bool[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"]) -> SilhouetteFit | None:
    """Hold the body against the mask; None where neither shows anything worth speaking of."""
    least = MIN_SHARE * mask.size
    covered, shown = int(body.sum()), int(mask.sum())
    if covered < least:
        return None if shown < least else SilhouetteFit(1.0, 0.0)
    common = int((body & mask).sum())
    return SilhouetteFit(1.0 - common / covered, common / (covered + shown - common))


def summary(fits: Iterable[SilhouetteFit]) -> FitSummary | None:
    """Summarise the figures of several views; None for none."""
    figures = np.array([(fit.outside, fit.iou, fit.verdict == "bad") for fit in fits], dtype=np.float64)
    if not len(figures):
        return None
    outside, iou, bad = figures.T
    return FitSummary(
        len(figures), float(np.median(outside)), float(outside.max()), float(np.median(iou)), int(bad.sum())
    )


@dataclass(frozen=True)
class ViewCheck:
    """Findings and measurements of one view.

    Attributes:
        camera: name of the camera.
        frame: number of the frame.
        findings: defects of the view.
        mask_share: share of the image that the mask covers; None without a usable mask.
        fit: silhouette of the body against the mask; None without a body, a usable mask, or a visible person.
        plain: plain background colour of a photograph, else None.
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
    """Open image, mask, labels and normals of one view.

    Args:
        capture: at the size at which silhouettes are compared.
        camera, frame: with an image.
        body: vertices and faces of the posed body; None where there are no parameters.
    """
    # The reader resamples and undistorts, so that damage anywhere in the file shows.
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
    findings += _turned(capture, camera, frame, image)
    # Labels and normals are decoded for their errors alone.
    opened("label", reader.labels)
    opened("normal", reader.normals)
    if alpha is None:
        return ViewCheck(camera, frame, tuple(findings))
    mask = alpha > OPAQUE
    silhouette = None if body is None else body_silhouette(*body, capture.cameras[camera])
    # A mask that cannot be the person's makes every further comparison meaningless.
    wrong = _wrong_mask(mask, silhouette)
    if wrong is not None:
        kind, words = wrong
        path = capture.file(camera, frame, "mask")
        return ViewCheck(camera, frame, (*findings, Finding(kind, f"mask {path}: {words}", camera, frame)), mask.mean())
    plain = None
    if image is not None:
        name = f"image {capture.file(camera, frame)}"
        background = capture.recording.background
        # A photograph must not be on a plain colour; a composited image must be on the declared one.
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


def _turned(capture: Capture, camera: str, frame: int, image: np.ndarray | None) -> Iterator[Finding]:
    """Find images and masks that ask for a turn by their EXIF orientation, and say whether it is made."""
    for kind in ("image", "mask"):
        path = capture.file(camera, frame, kind)
        if path is None or image is None:
            continue
        tag, source = image_orientation(path), capture.reader(camera).camera
        words = f"{kind} {path}: EXIF orientation {tag} asks for a turn or a mirroring of the stored pixels"
        # A quarter turn that brings the image to the calibration's size is made (`smplxpp.capture.views.check_size`).
        if tag >= 5 and image_size(path) != (source.width, source.height):
            advice = "nothing, if the calibration was made on the turned pictures, whose width and height it has"
            yield Finding("image-turned", f"{words}, which is made", camera, frame, advice)
        elif tag != 1:
            yield Finding("image-turned", f"{words}, which is not made", camera, frame)


def _wrong_mask(mask: Bool[np.ndarray, "H W"], silhouette: Bool[np.ndarray, "H W"] | None) -> tuple[str, str] | None:
    """Return kind and words of a mask that cannot be one of the person, else None."""
    share = float(mask.mean())
    # Even a close-up leaves a corner of background.
    if share > 0.995:
        return "mask-full", f"covers {share:.1%} of the image"
    visible = None if silhouette is None else float(silhouette.mean())
    if share < MIN_SHARE / 10:
        # Without a body it is unknown whether the camera sees the person.
        seen = visible is not None and visible > 2 * MIN_SHARE
        return ("mask-empty", f"is empty, but the body covers {visible:.1%} of the image") if seen else None
    if silhouette is not None and visible is not None and visible > MIN_SHARE:
        fit, inverse = compare_silhouettes(silhouette, mask), compare_silhouettes(silhouette, ~mask)
        assert fit is not None and inverse is not None  # the body is large enough to say something
        # Inverted: most of the body is outside of the mask, and it overlaps with the complement.
        inverted = fit.outside > 0.7 and inverse.iou > 0.5
    else:
        # The person rarely touches most of the image's rim, the background does.
        rim = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()
        # Without a body: most of the rim is opaque, more than of the whole image.
        inverted = rim > 0.6 and share > 0.5 and rim > share
    return ("mask-inverted", "covers the background, not the person") if inverted else None


def _against_background(
    image: UInt8[np.ndarray, "H W 3"], alpha: UInt8[np.ndarray, "H W"], colour: Float[np.ndarray, " 3"]
) -> Iterator[tuple[str, str]]:
    """Yield kind and words where an image is not on the colour (of 255) outside its mask."""
    # (N, 3) pixels that the mask declares as background, sampled with a step.
    outside = _outside(image, alpha)
    if not len(outside):
        return
    found = np.median(outside, axis=0)
    if np.abs(found - colour).max() > _BACKGROUND_TOLERANCE:
        declared = colour.round().astype(int).tolist()
        yield "background", f"RGB {found.astype(int).tolist()} outside the mask, where the capture declares {declared}"
        return
    # Each sampled pixel stands for `_STEP` squared pixels of the image.
    shown = int((np.abs(outside - colour).max(axis=1) > _SHOWS_SOMETHING).sum()) * _STEP**2
    area = int((alpha > OPAQUE).sum())
    # Area outside the mask that shows something, as a share of the mask's.
    mismatch = 0.05
    if shown > mismatch * area and shown > MIN_SHARE * alpha.size:
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
