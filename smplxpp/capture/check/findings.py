"""Findings: what is wrong, where, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from smplxpp.core.errors import InputError

Status = Literal["fail", "warn"]
Area = Literal["files", "splits", "masks", "parameters", "calibration"]

# kind -> (area, status, what to do). Each kind has a paragraph in docs/capture_check.md.
KINDS: dict[str, tuple[Area, Status, str]] = {
    "file-damaged": ("files", "fail", "copy the file from its source again, or delete it to leave the view out"),
    "file-size": ("files", "fail", "give images, masks and calibration of one resolution"),
    "image-turned": (
        "files",
        "warn",
        "pixels count as stored; if the calibration was made by a reader that turns (OpenCV), turn the pixels and "
        "remove the tag: exiftran -ai FILE, or PIL.ImageOps.exif_transpose",
    ),
    "file-other": ("files", "fail", "correct the file, or delete it"),
    "left-aside": ("files", "warn", "docs/captures.md says what each layout's reader leaves aside, and why"),
    "rig-guessed": (
        "files",
        "warn",
        "see whether it is right; --calibration, --units and --up of `capture convert` say it",
    ),
    "rig-videos": ("files", "warn", "convert the rig: smplxpp capture convert"),
    "camera-uncalibrated": ("files", "fail", "add the camera to the calibration, or delete the folder"),
    "camera-without-images": ("files", "fail", "add its images, or take the camera out of the calibration"),
    "image-missing": ("files", "warn", "copy the missing images; the views are left out until then"),
    "map-missing": ("files", "warn", "copy the missing maps, or correct the lists in capture.json"),
    "frame-alone": ("files", "fail", "copy the other cameras' images of these frames, or delete the single ones"),
    "split-empty": ("splits", "fail", "correct the cameras and frames of the splits in capture.json"),
    "split-leftover": ("splits", "warn", "add them to one of the splits in capture.json if they should be used"),
    "masks-none": ("masks", "fail", "make mattes with any tool and name their folder with --masks"),
    "mask-missing": ("masks", "fail", "make the missing mattes; views without one cannot be trained on"),
    "mask-empty": ("masks", "fail", "make these mattes again, or delete these views' images"),
    "mask-full": ("masks", "fail", "make these mattes again: nothing was cut out"),
    "mask-inverted": ("masks", "fail", "invert these masks: 255 is the person, 0 the background"),
    "mask-mismatch": ("masks", "fail", "check that image and mask show the same frame, and that nothing is cut off"),
    "background": ("masks", "fail", 'photographs are declared with `"background": null` in capture.json'),
    "background-plain": ("masks", "warn", 'declare the colour as `"background"` in capture.json'),
    "camera-sees-nobody": ("masks", "warn", "leave the camera out, or check that its folder is the right one"),
    "params-none": (
        "parameters",
        "fail",
        "fit the body and bring it here with `smplxpp params convert`, or name a file with --params",
    ),
    "params-missing": ("parameters", "fail", "fit these frames too, or delete their images"),
    "params-broken": ("parameters", "fail", "fit these frames again; they are left out"),
    "params-body": ("parameters", "fail", "name the body model that the parameters were fitted with: --body FILE"),
    "params-betas": (
        "parameters",
        "fail",
        "shapes lie within 5 standard deviations: check the file's layout and the body model, or regularise the fit",
    ),
    "params-betas-vary": ("parameters", "warn", "a person has one shape: fit it once for all frames"),
    "params-expression": ("parameters", "fail", "check the file's layout and the body model, or regularise the fit"),
    "params-angles": ("parameters", "fail", "write rotation vectors in radians"),
    "params-units": ("parameters", "fail", "write cameras and parameters in metres, in one world"),
    "params-jump": ("parameters", "fail", "fit these frames again, or check that frames are numbered in time's order"),
    "world-up": (
        "calibration",
        "warn",
        "turn cameras and parameters as the line says; parameters of your own by `smplxpp params convert --up`",
    ),
    "calibration": (
        "calibration",
        "fail",
        "check the calibration's conventions (docs/captures.md), its units, and "
        "that the parameters belong to this capture and this body model",
    ),
    "calibration-camera": (
        "calibration",
        "fail",
        "check this camera's calibration and that its folder holds its own images, or leave it out",
    ),
    "calibration-frame": (
        "calibration",
        "fail",
        "fit these frames again, or check that cameras and parameters show one moment",
    ),
    "lens-loss": (
        "calibration",
        "warn",
        "nothing, if the person is inside; else undistort the images to a smaller focal length with another tool",
    ),
    "calibration-loose": (
        "calibration",
        "warn",
        "refine the fit or the calibration; a noisy tracker gives such figures, and what is trained on them is blurred",
    ),
}
AREAS: tuple[Area, ...] = ("files", "splits", "masks", "parameters", "calibration")


@dataclass(frozen=True)
class Finding:
    """Something that a person should do something about.

    Attributes:
        kind: a key of `KINDS`.
        message: what is wrong, with the file's name where there is one.
        camera, frame: what it concerns; None: all.
        advice: what to do in this very case; "": what is always to be done about this kind.
    """

    kind: str
    message: str
    camera: str | None = None
    frame: int | None = None
    advice: str = ""

    @property
    def area(self) -> Area:
        """What of the capture it is about."""
        return KINDS[self.kind][0]

    @property
    def status(self) -> Status:
        """`fail`: training would fail or learn something wrong; `warn`: usable, look at it."""
        return KINDS[self.kind][1]

    @property
    def remedy(self) -> str:
        """Return the remedy of the finding."""
        return self.advice or KINDS[self.kind][2]

    def as_dict(self) -> dict[str, object]:
        """Return the finding as JSON values."""
        return {
            "kind": self.kind,
            "area": self.area,
            "status": self.status,
            "message": self.message,
            "camera": self.camera,
            "frame": self.frame,
            "remedy": self.remedy,
        }


def unreadable_finding(error: InputError, camera: str | None, frame: int | None) -> Finding:
    """Make the finding of a file that a reader refused."""
    if "whole image" in error.expected or "existing file" in error.expected:
        kind = "file-damaged"
    else:
        kind = "file-size" if " pixels, " in error.expected else "file-other"
    return Finding(kind, f"{error.subject}: expected {error.expected}, received {error.received}", camera, frame)


def grouped(findings: Iterable[Finding]) -> list[tuple[Finding, ...]]:
    """Put findings of one kind and one remedy together: by area, failures first within one."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.kind, finding.remedy), []).append(finding)
    order = list(KINDS)
    ranked = sorted(
        groups.values(), key=lambda g: (AREAS.index(g[0].area), g[0].status != "fail", order.index(g[0].kind))
    )
    return [tuple(group) for group in ranked]
