"""What a build takes: its inputs, and every choice that changes its result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from smplxpp.assemble import FillHolesConfig
from smplxpp.body import Whose
from smplxpp.capture import Capture
from smplxpp.clean import BridgeConfig
from smplxpp.clean.scan_frame import AUTO, check_height
from smplxpp.core import (
    BodyParams,
    InputError,
    Labels,
    MeshLike,
    require_at_least,
    require_between,
    require_choice,
    require_known,
)
from smplxpp.core.errors import one_line
from smplxpp.core.labels import PartRule
from smplxpp.segment import LABEL_SETS, LabelSet, find_label_set
from smplxpp.template.texture import LAYOUTS, TEXTURE_SIZES

STEPS = (
    *("reconstruct", "locate", "register"),
    *("capture", "body", "segment", "clean", "transfer", "unpose", "assemble", "validate"),
)
"""The steps of a build in their order. The first three make what is not given: a scan, and the body in it."""
# Automatic units and axes are found from the person's shape (`smplxpp.clean.scan_frame`).
UNITS = (AUTO, "m", "cm", "mm", "inch")
UP_AXES = (AUTO, "y", "z", "x", "-y", "-z", "-x")
WHOSE: tuple[str, ...] = get_args(Whose)
LABEL_SOURCES = (AUTO, "scan", "views", "body")


@dataclass(frozen=True)
class BuildConfig:
    """Choices of a build that change its result.

    Attributes:
        units: units of the scan, one of `UNITS`. "auto": found from the person's height where the scan comes alone,
            else metres.
        up: upward axis of the scan, one of `UP_AXES`. "auto": found where the scan comes alone, else +Y.
        height: the person's stature in metres, standing upright, for a scan that comes alone and has no unit. The scan
            is scaled until the body that is found in it, in whatever pose, has it. None: units tell the size.
        whose: whose parameters are given with a scan, one of `WHOSE`. "auto": as their file tells. Those of a family
            are a start for the search where the body is the open body, because their shape is not its.
        frame: number of the reference frame, near the T-pose.
        protocol: the capture's protocol, which names the files that are read. None: without one.
        keypoints: folder of keypoints that replaces the capture's own.
        masks: folder of masks that replaces the capture's own.
        landmarks: points placed by hand on the scan, a file or points by name. They tell where the body is.
        corrections: file of labels corrected by hand, as `smplxpp label` writes it.
        label_set: label set that labels and label maps use: a name, a file (labels.yaml, or a JSON mapping) or a
            `LabelSet`. One of one's own has more classes than the built-in ones. "auto": "capture" with a capture, else
            "4ddress".
        label_source: "scan" takes labels that come with the scan, "views" lets label maps vote, "body" asks the fitted
            body and the colours. "auto": the first of views, scan and body that there is.
        register: whether the body is registered to the capture (or to the scan), "on", "off" or "auto". "auto": where
            the capture states that its parameters are tracked, and where it has none.
        detector: keypoint model that tells front and limbs of a scan without parameters: "mediapipe" or an ONNX
            file. None: the surface alone decides.
        budgets: number of faces kept by part name; others keep what their label says.
        rules: how a part follows the skeleton by its name, or a piece of it by name and number ("upper/1"; 0 is the
            largest in area): "auto", "rigid:JOINT", "chain:JOINT,JOINT,..." or "isolate", see `TransferConfig`. They
            come before the rules of the labels.
        remesh: method that makes the parts' faces, "quadric" or "isotropic".
        clearance_mm: distance kept between layers, millimetres, 0.1 to 10.
        max_influences: joints that a vertex may follow.
        bridges: settings for cutting faces that bridge two limbs; `rounds=0` disables it.
        fill_holes: settings for closing the holes that this leaves; `width=0` disables it.
        method: skin-weight transfer, "ours", or "paper" for robust transfer as published.
        texture_size: texels a side of the template's pictures, one of `TEXTURE_SIZES`; 0: no texture.
        texture_layout: "one" picture for all parts, or one a "part"; then the body lies as in its own file.
        normal_map: paint the scan's normals onto the parts, too. Of parts with the default budgets they differ by 1 to
            3 degrees from the parts' own, so that it shows with small budgets alone.
        samples: surface samples of the validation.
        seed: of the samples.
        accept_failures: build on a body that was found with too little confidence; the command then ends with status 0
            although checks fail.

    Example:
        >>> BuildConfig(budgets={"upper": 8000}).clearance_mm
        1.0
    """

    units: str = AUTO
    up: str = AUTO
    height: float | None = None
    whose: Whose = "auto"
    frame: int = 0
    protocol: str | None = None
    keypoints: Path | None = None
    masks: Path | None = None
    landmarks: Path | Mapping[str, Any] | None = None
    corrections: Path | None = None
    label_set: str | LabelSet = AUTO
    label_source: str = AUTO
    register: Literal["auto", "on", "off"] = "auto"
    detector: str | None = None
    budgets: dict[str, int] = field(default_factory=dict)
    rules: dict[str, str] = field(default_factory=dict)
    remesh: str = "quadric"
    clearance_mm: float = 1.0
    max_influences: int = 8
    bridges: BridgeConfig = field(default_factory=BridgeConfig)
    fill_holes: FillHolesConfig = field(default_factory=FillHolesConfig)
    method: str = "ours"
    texture_size: int = 2048
    texture_layout: str = "one"
    normal_map: bool = False
    samples: int = 100_000
    seed: int = 0
    accept_failures: bool = False

    def __post_init__(self) -> None:
        # Check choices when the options are made: a wrong one would otherwise surface minutes later, in the step that
        # uses it.
        for name, choices in (("units", UNITS), ("up", UP_AXES), ("label_source", LABEL_SOURCES)):
            require_choice(f"option {name}", getattr(self, name), choices)
        if self.height is not None:
            check_height(self.height, self.units)
        require_choice("option whose", self.whose, WHOSE)
        require_choice("option register", self.register, (AUTO, "on", "off"))
        require_choice("option method", self.method, ("ours", "paper"))
        require_choice("option texture-size", str(self.texture_size), [str(size) for size in TEXTURE_SIZES])
        require_choice("option texture-layout", self.texture_layout, LAYOUTS)
        # The labels of a file are known when it is read, before the first step.
        if isinstance(self.label_set, LabelSet) or self.label_set in (AUTO, *LABEL_SETS):
            self.check_parts(find_label_set("4ddress" if self.label_set == AUTO else self.label_set).labels)
        for name, rule in self.rules.items():
            PartRule.parse(rule, subject=f"option rules: {name}")
        # Millimetres; a value outside this range is most likely in another unit.
        require_between("option clearance-mm", self.clearance_mm, 0.1, 10.0)
        # The 95th percentile of 1000 samples rests on 50 of them; fewer would make the limits of `validate` a matter
        # of chance.
        for name, value, least in (
            ("max-influences", self.max_influences, 1),
            ("samples", self.samples, 1000),
            ("seed", self.seed, 0),
            ("frame", self.frame, 0),
            ("budgets", min(self.budgets.values(), default=100), 100),
        ):
            require_at_least(f"option {name}", value, least)

    def check_parts(self, labels: Labels) -> None:
        """Refuse budgets and rules of parts that no label has.

        Raises:
            InputError: it names the part.
        """
        parts = [label.name for label in labels if label.face_budget]
        require_known("option budgets", self.budgets, parts)
        require_known("option rules", (name.partition("/")[0] for name in self.rules), parts)
        for name in self.rules:
            if "/" in name and not name.partition("/")[2].isdigit():
                raise InputError(
                    "option rules", expected="PART, or PART/NUMBER of a piece, as upper/1", received=repr(name)
                )


@dataclass(frozen=True)
class BuildInputs:
    """The inputs of one build, after it was decided which of them are used and which are made.

    Attributes:
        subject: name used in the report.
        scan: clothed scan of the reference frame; None where it is reconstructed and no file keeps it.
        params: body parameters. None: they are registered, or found in the scan.
        frame: number of the frame in its capture. Trainings take this frame's photographs.
        params_row: the frame's row in parameters of several frames.
        labels: labels of the scan's vertices or faces. None: the scan's own, label maps, or the body decide.
        label_maps: label image by camera name.
        photographs: image of the frame by camera name. They tell whether the scan is mirrored.
        cameras: camera file of label maps and photographs.
        label_set: label set that labels and label maps use: a name, a file or a `LabelSet`.
        label_source: "auto" takes the labels that there are; "body" ignores them.
        reconstructs: whether the scan is reconstructed from photographs.
        locates: whether the body has to be found in the scan.
        registers: whether the parameters come from a registration.
        motion: parameters of the capture's frames, for validation; may be None.
        start: parameters of another body of the family in the scan, which tell where limbs are and no shape.
        whose: whose `params`, `motion` or `start` are, one of `WHOSE`.
        body: SMPL-X-layout body file; None for the open body.
        protocol: protocol of the capture that names these files; None without one.
    """

    subject: str
    scan: Path | MeshLike | None
    params: Path | BodyParams | None
    frame: int = 0
    params_row: int = 0
    labels: Path | np.ndarray | None = None
    label_maps: dict[str, Path] = field(default_factory=dict)
    photographs: dict[str, Path] = field(default_factory=dict)
    cameras: Path | None = None
    label_set: str | LabelSet = "4ddress"
    label_source: str = "auto"
    reconstructs: bool = False
    locates: bool = False
    registers: bool = False
    motion: Path | BodyParams | None = None
    start: Path | BodyParams | None = None
    whose: Whose = "auto"
    body: Path | None = None
    protocol: str | None = None

    __repr__ = one_line

    @property
    def labels_used(self) -> Labels:
        """The labels that the label set's ids stand for."""
        return find_label_set(self.label_set).labels

    @property
    def scan_file(self) -> Path:
        """The scan's file, which every run has; builds in memory read `scan`."""
        assert isinstance(self.scan, Path), "a run keeps its scan in a file"
        return self.scan

    @property
    def steps(self) -> tuple[str, ...]:
        """The steps of the build in their order: those that make what is not given where something is missing."""
        left_out = {"reconstruct": not self.reconstructs, "locate": not self.locates, "register": not self.registers}
        return tuple(step for step in STEPS if not left_out.get(step, False))


def resolved(config: BuildConfig, inputs: BuildInputs) -> BuildConfig:
    """Return the choices with units and axis that are "auto" set to metres and +Y, unless they are to be found.

    They are found from the shape of the person where the scan comes alone. Parameters, cameras and a scan share one
    world, which is in metres.
    """
    if inputs.locates and not inputs.registers:
        return config
    return replace(
        config, units="m" if config.units == AUTO else config.units, up="y" if config.up == AUTO else config.up
    )


@dataclass(frozen=True)
class RegisterInputs:
    """Where a registration takes its observations from: a capture, or one scan.

    Attributes:
        capture: folder of any known layout, or an open capture.
        params: the fit to start from, which replaces the capture's own.
        start: False: no fit is used, and the registration begins with keypoints.
        protocol: name of the capture's files that are read, None without one.
        frames: numbers; None for all that are trained on or held out.
        hold_out: cameras that are not used, in the place of those that the capture holds out.
        body: SMPL-X-layout body file, None for the open body.
        scan: the reference frame's scan, which replaces the capture's.
        frame: number of the reference frame.
        labels: labels of that scan's vertices or faces. None: its frame's label maps vote.
        label_set: of the scan's labels.
        units: of scan files.
        up: upward axis of scan files.
        seed: of the points that are sampled.
        keypoints: folder of keypoints that replaces the capture's own.
        masks: folder of masks that replaces the capture's own.
        scans: folder of a scan a frame that replaces the capture's own.
        subject: place of the person whose keypoints are taken, where several are in view; None: the first.
        shape: body parameters whose shape all frames have; None: it is fitted.
    """

    capture: Path | Capture | None = None
    params: Path | BodyParams | None = None
    start: bool = True
    protocol: str | None = None
    frames: tuple[int, ...] | None = None
    hold_out: tuple[str, ...] = ()
    body: Path | None = None
    scan: Path | MeshLike | None = None
    frame: int = 0
    labels: Path | np.ndarray | None = None
    label_set: str | LabelSet = "capture"
    units: str = "m"
    up: str = "y"
    seed: int = 0
    keypoints: Path | None = None
    masks: Path | None = None
    scans: Path | None = None
    subject: int | None = None
    shape: Path | None = None

    @property
    def root(self) -> Path | None:
        """Folder of the capture; None for a scan alone."""
        return self.capture.root if isinstance(self.capture, Capture) else self.capture

    @property
    def scan_file(self) -> Path | None:
        """The scan's file; None without one, or for a scan in memory."""
        return self.scan if isinstance(self.scan, Path) else None


@dataclass(frozen=True)
class ReconstructInputs:
    """Where a reconstruction takes its photographs from.

    Attributes:
        capture: folder of any known layout, or an open capture.
        frames: numbers; None: all that are trained on.
        hold_out: cameras that are not used, in the place of those that the capture holds out.
        masks: folder of masks that replaces the capture's own.
        protocol: name of the capture's files that are read, None without one.
        refine: compare the photographs; False: the silhouettes alone.
        cell_mm: cell size of the grid, millimetres; None: by the photographs' resolution.
        mesh: another program's surface of the one frame, which replaces ours.
        dissent: number of views that may see background at a point of the surface.
        body: SMPL-X-layout body file that a turning person's poses are for; None for the open body.
    """

    capture: Path | Capture
    frames: tuple[int, ...] | None = None
    hold_out: tuple[str, ...] = ()
    masks: Path | None = None
    protocol: str | None = None
    refine: bool = True
    cell_mm: float | None = None
    dissent: int = 0
    mesh: Path | None = None
    body: Path | None = None

    @property
    def root(self) -> Path:
        """Folder of the capture, also of an open one."""
        return self.capture.root if isinstance(self.capture, Capture) else self.capture
