"""Build a template in memory: the steps in order, each from what the steps before it returned."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from smplxpp.body import BodyModel
from smplxpp.build.assemble import add_texture, assemble_parts
from smplxpp.build.config import BuildConfig, BuildInputs, ReconstructInputs, RegisterInputs
from smplxpp.build.data import LocatedInScan, RestPart
from smplxpp.build.inputs import check_inputs, given_motion, plan_build
from smplxpp.build.locate import locate_in_scan, require_found
from smplxpp.build.observe import observe
from smplxpp.build.parts import clean_scan, transfer_to_parts, unpose_parts
from smplxpp.build.prepare import given_params, pose_fit, prepare_scan, registered_frame, start_params
from smplxpp.build.reconstruct import (
    check_masks,
    open_photographs,
    reconstruct_frame,
    reconstruction_output,
    surface_maker,
    usable_cameras,
    usable_frames,
    write_surface,
)
from smplxpp.build.register import Registration, register_observed
from smplxpp.build.report import BuildReport, BuildResult
from smplxpp.build.request import BuildRequest, opened, with_params
from smplxpp.build.scan import ScanFile, read_scan
from smplxpp.build.segment import label_faces, label_source
from smplxpp.build.validate import validate_template
from smplxpp.capture import Capture
from smplxpp.clean.remesh import require_remesher
from smplxpp.core import BodyParams, MeshLike, StageOutput, ignore_progress
from smplxpp.detect import load_detector
from smplxpp.register import RegisterConfig
from smplxpp.segment import Corrections

OnStage = Callable[[str, bool], None]
"""Called with a step's name before (False) and after (True) it."""
_T = TypeVar("_T")


def build_template(
    scan: str | Path | MeshLike | None = None,
    *,
    body: str | Path | BodyModel | None = None,
    params: str | Path | BodyParams | None = None,
    labels: str | Path | np.ndarray | None = None,
    capture: str | Path | Capture | None = None,
    config: BuildConfig | None = None,
    on_stage: OnStage | None = None,
) -> BuildResult:
    """Build the template of a clothed person, in memory.

    This is what `smplxpp build` does, with the same digits: nothing is kept on disk, and nothing that stands is reused.
    Steps that make what is not given run first: a scan is reconstructed from the capture's photographs, parameters are
    registered to the capture, or the body is located in the scan.

    Args:
        scan: clothed scan of the reference frame: a file, a `TriangleMesh`, a `trimesh.Trimesh` or a pair (vertices,
            faces). None: that of the capture.
        body: SMPL-X-layout body, a file or a model; None: the open body.
        params: body parameters of the scan, a file or `BodyParams`. None: those of the capture, or they are registered
            or located.
        labels: labels of the scan's vertices or faces, a file or an array of ids of `config.label_set`, which may be a
            `LabelSet` of one's own. None: the scan's own, votes of label maps, or the body and the colours.
        capture: folder of a capture, or an open one. Either this or a scan is given.
        config: choices; None: the defaults.
        on_stage: called with the name of a step before (False) and after (True) it; names are those of `STEPS`.

    Returns:
        The template, its parts, a report with checks against limits, and the capture with the parameters used.

    Raises:
        BodyNotFoundError: no person was found in the scan, or none with enough confidence; the error has a picture.
        InputError: unusable input; the message says what was expected.

    Example:
        >>> result = smplxpp.build_template(capture="data/fixtures/person")  # doctest: +SKIP
        >>> print(result.report)  # doctest: +SKIP
        >>> result.template.export("anna.glb")  # doctest: +SKIP
    """
    with tempfile.TemporaryDirectory(prefix="smplxpp_build_") as folder:
        request = BuildRequest(
            scan=_path(scan),
            capture=_path(capture),
            params=_path(params),
            labels=_path(labels),
            body=_path(body),
            config=config or BuildConfig(),
            surface=Path(folder) / "scan.ply",
        )
        return _Build(request, on_stage or (lambda name, done: None)).run()


def _path(value: str | _T) -> Path | _T:
    """A name as a path; anything else as it is."""
    return Path(value) if isinstance(value, str) else value


class _Build:
    """One running build: the plan, the body, and the checks, numbers and times of the steps so far."""

    def __init__(self, request: BuildRequest, on_stage: OnStage) -> None:
        self.request, self.on_stage = request, on_stage
        self.plan = plan_build(request)
        # Refuse what only the last steps would find, before work starts.
        given = request.body if isinstance(request.body, BodyModel) else None
        self.body = check_inputs(self.plan.inputs, given, config=self.plan.config)
        self.outputs: dict[str, StageOutput] = {}
        self.seconds: dict[str, float] = {}

    @property
    def inputs(self) -> BuildInputs:
        return self.plan.inputs

    @property
    def config(self) -> BuildConfig:
        return self.plan.config

    def run(self) -> BuildResult:
        """Run the steps of the build in their order."""
        config, inputs, body = self.config, self.inputs, self.body
        # Ask for optional programs and read small files first: a missing one would be noticed only after minutes.
        require_remesher(config.remesh)
        if config.detector is not None:
            load_detector(config.detector)
        corrections = (
            None if config.corrections is None else Corrections.load(config.corrections, labels=inputs.labels_used)
        )

        # Make what is not given: the scan, the body in it, the parameters of the capture's frames.
        if self.plan.reconstruction is not None:
            self._reconstruct(self.plan.reconstruction)
        located, registration = None, None
        file: ScanFile | None = None
        # Locating reads the scan already, which is kept, because Poisson surfaces of clouds are expensive.
        if inputs.locates:
            with self._step("locate") as step:
                file = self._read_scan()
                located, step.output = locate_in_scan(
                    file,
                    body,
                    landmarks=config.landmarks,
                    detector=config.detector,
                    height=config.height,
                    start=start_params(inputs, body),
                )
                file = file.scaled(located.scale)
            if not config.accept_failures:
                numbers = step.output.numbers
                require_found(
                    *(file.clean.mesh, body, located.params),
                    confidence=numbers["confidence"],
                    findings=numbers["findings"] or numbers["problems"],
                )
        if self.plan.registration is not None:
            registration = self._register(self.plan.registration, located)

        # Prepare the scan and one frame of parameters.
        with self._step("capture") as step:
            file = file or self._read_scan()
            scan, step.output = prepare_scan(file)
            # One row of parameters: the template is built in the reference frame's pose.
            params = self._params(located, registration)
        with self._step("body") as step:
            fit, step.output = pose_fit(scan.mesh, body, params)
        with self._step("segment") as step:
            labelled, step.output = label_faces(scan, inputs, body, params, file=file, corrections=corrections)
        face_labels, labels = labelled.face_labels, inputs.labels_used

        # Cut the scan into parts, give them weights, bring them to the T-pose and put them onto the body.
        with self._step("clean") as step:
            cleaned, step.output = clean_scan(scan, face_labels, config, labels, found=label_source(inputs) == "body")
        with self._step("transfer") as step:
            posed, weights, step.output = transfer_to_parts(cleaned, fit, body, config, labels)
        with self._step("unpose") as step:
            at_rest, step.output = unpose_parts(posed, weights, fit)
        parts = {name: RestPart(part, weights[name], at_rest[name].vertices) for name, part in posed.items()}
        with self._step("assemble") as step:
            template, step.output = assemble_parts(
                body, params, scan, face_labels, fit, cleaned, parts, config, labels=labels
            )
            template, painted = add_texture(template, params, scan, face_labels, inputs, config, body)
            step.output = replace(step.output, numbers=step.output.numbers | painted)
        with self._step("validate") as step:
            # The motion that the template is tried with: the registered one, else the given one; None without either.
            motion = registration.fit.params if registration is not None else given_motion(inputs, body)
            _, step.output = validate_template(template, params, scan, face_labels, posed, motion, inputs, config)
        return BuildResult(template, parts, BuildReport(self.outputs, self.seconds), self._capture(registration))

    @contextmanager
    def _step(self, name: str) -> Iterator[_Step]:
        """Around the lines of a step, which set its output; keeps that and the time."""
        self.on_stage(name, False)
        step, begin = _Step(), time.perf_counter()
        yield step
        self.outputs[name], self.seconds[name] = step.output, time.perf_counter() - begin
        self.on_stage(name, True)

    def _read_scan(self) -> ScanFile:
        assert self.inputs.scan is not None
        return read_scan(self.inputs.scan, units=self.config.units, up=self.config.up, height=self.config.height)

    def _reconstruct(self, asked: ReconstructInputs) -> None:
        """Reconstruct the scan of the reference frame into the request's file, because scans are read from files."""
        with self._step("reconstruct") as step:
            capture = open_photographs(asked)
            cameras = usable_cameras(capture, asked.hold_out)
            # The plan asks for the reference frame alone.
            (frame,) = usable_frames(capture, asked.frames)
            check_masks(capture, cameras, (frame,))
            surface, numbers = reconstruct_frame(
                capture, cameras, frame, surface_maker(asked), ignore_progress, body=self.body
            )
            assert self.request.surface is not None
            write_surface(self.request.surface, surface)
            step.output = reconstruction_output({frame: numbers}, {}, cameras)

    def _register(self, asked: RegisterInputs, located: LocatedInScan | None) -> Registration:
        """Register the body to the capture, or to the scan."""
        with self._step("register") as step:
            found = None if located is None else lambda: located
            observed = observe(asked, self.body, landmarks=self.config.landmarks, located=found)
            registration, step.output = register_observed(
                observed, self.body, at=asked.frame, config=RegisterConfig(seed=asked.seed)
            )
        return registration

    def _params(self, located: LocatedInScan | None, registration: Registration | None) -> BodyParams:
        """The reference frame's parameters: given, registered or located."""
        given = given_params(self.inputs, self.body)
        if given is not None:
            return given
        if registration is not None:
            return registered_frame(self.inputs.frame, registration.fit.frames, registration.fit.params)
        assert located is not None, "without parameters the body is located"
        return located.params

    def _capture(self, registration: Registration | None) -> Capture | None:
        """The capture with the parameters that were used."""
        request, config = self.request, self.config
        if request.capture is None:
            return None
        # A registration replaces the parameters of the capture, so that the files of a fit are not read.
        given = request.params if isinstance(request.params, BodyParams) else request.named_params
        capture = opened(
            request.capture,
            params=None if registration is not None else given,
            frame=config.frame,
            body=self.body,
            protocol=request.protocol,
            keypoints=config.keypoints,
            masks=config.masks,
        )
        if registration is None:
            return capture
        # Marked as estimated, so that evaluations do not take them for ground truth.
        return with_params(capture, registration.fit.frames, registration.fit.params, estimated=True)


class _Step:
    """Holds the output of a step while it runs."""

    output: StageOutput
