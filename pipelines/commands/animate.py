"""`smplxpp animate`: a template or a trained student moving, as a film, pictures or (the template) an animated GLB."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from jaxtyping import Float, UInt8
from rich.console import Console
from rich.progress import track

from pipelines.commands.animate_student import StudentFilm, student_frames
from pipelines.commands.driving import Driving, unshaped
from pipelines.commands.options import ClothMode, Lighting, OptionalFloat, OptionalInt
from pipelines.commands.templates import BUNDLE_SUFFIX, load_run_template
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import GARMENTS, STUDENT
from smplxpp.cloth import DriverConfig, Garment, cut_garment
from smplxpp.cloth.garment_file import load_garments
from smplxpp.cloth.play import play
from smplxpp.cloth.quality import ClothQuality, all_checks
from smplxpp.core import DEFAULT_FPS, BodyParams, InputError, require_at_least, require_positive, spread
from smplxpp.core.camera import Camera
from smplxpp.figures import VIEWS, blend_joint_colors, fit_cameras, render_shaded, turntable_cameras
from smplxpp.figures.film import FRAME_FOLDER, SUFFIXES, write_film
from smplxpp.raster.shading import ShadeStyle
from smplxpp.template.template import Template

_BLOCK = 16  # frames posed at a time


@dataclass(frozen=True)
class Animate:
    """Options of `smplxpp animate`."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp build` wrote, or a bundle NAME.avatar that `smplxpp export` wrote."""
    params: Path
    """A motion: body parameters in any layout that `smplxpp params convert` reads, or a skeleton's (.bvh, .glb, .vrm,
    .fbx). Their shape is ignored: the template has one."""
    out: Path
    """Result: .mp4, .gif, .glb, or a name without a suffix for a folder of PNG pictures."""
    model: Literal["auto", "template", "student"] = "auto"
    """Model to draw: the textured template, or the trained student in the runtime. auto: the student where the run has
    one, unless --out, --colors or --loose-parts ask for what the template alone has. A bundle is a student."""
    outside: Literal["keep", "clamp"] = "keep"
    """Poses of a student outside the range of its training. keep: show them and print a note. clamp: limit each joint
    to the range."""
    codes: Literal["null", "trained"] = "null"
    """Latent codes of a student's field: zero, as for any new motion, or those of its training frames. The motion's
    rows are then the training frames by number (with --cloth field, without --interpolate)."""
    interpolate: OptionalFloat = None
    """Frame rate to resample the motion to at the same speed; rotations between frames are interpolated along the
    shortest arc (students only)."""
    fps: OptionalFloat = None
    """Frames a second; by default those of the parameters (or 30) over --step, so that the speed is true."""
    view: Literal["front", "side", "back", "three-quarter", "turntable"] = "front"
    """Position of the camera; turntable turns it once around over the whole film."""
    colors: Literal["scan", "labels", "semantic", "weights", "none"] = "scan"
    """Colours of the surface (pictures only; a GLB has those of the scan)."""
    cloth: ClothMode = "simulate"
    """What moves the loose clothes that the run has found (83_cloth), or that --loose-parts names: a simulation, the
    joints alone, or (students) their own field. A GLB's clothes always follow the joints."""
    floor: OptionalFloat = None
    """Height of the ground in metres, on which simulated clothes of who kneels or lies come to rest."""
    loose_parts: tuple[str, ...] = ()
    """Simulate these parts of the template, in the place of those that training found."""
    height: int = 720
    """Height of the picture in pixels."""
    width: OptionalInt = None
    """Width of the picture; by default as wide as the motion needs."""
    start: int = 0
    """First frame."""
    stop: OptionalInt = None
    """Frame after the last."""
    step: int = 1
    """Take every step-th frame."""
    driving: Annotated[Driving, tyro.conf.arg(name="")] = field(default_factory=Driving)
    """Whose motion it is."""
    lighting: Annotated[Lighting, tyro.conf.arg(name="")] = field(default_factory=Lighting)
    """The light that the person is shown in."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where a student is posed and drawn; cuda needs torch and gsplat. Clothes are simulated on the CPU."""
    json: bool = False
    """Print what was written as JSON."""
    _notes: tyro.conf.Suppress[list[str]] = field(default_factory=list, init=False)
    _quality: tyro.conf.Suppress[list[ClothQuality]] = field(default_factory=list, init=False)

    def run(self) -> dict:
        """Pose the template frame by frame and write the result, whole or not at all."""
        suffix = self.out.suffix.lower()
        self._check_options(suffix)
        if self._of_student:
            return self._student_film()
        template = load_run_template(self.run_folder)
        params, fps, before = self._chosen(
            self.driving.load(self.params, unshaped(template.body), fps=self._given_rate)
        )
        garments = [] if self.cloth == "skin" or suffix == ".glb" else self._garments(template)
        if suffix == ".glb":
            from smplxpp.export import write_glb

            write_glb(self.out, template, animation=params)
        else:
            # The iterator poses frames on demand, so that a long motion never lies in memory as a whole.
            posed = self._posed(template, garments, before, params, fps)
            # The first frame is posed before any file is touched: parameters of another body are refused here.
            first = next(posed)
            cameras = self._cameras(template, params)
            frames = self._frames(template, chain([first], posed), cameras)
            write_film(self.out, frames, fps=fps, size=(cameras[0].width, cameras[0].height))
        simulated = [garment.part for garment in garments]
        if not self.json:
            self._print(len(params), fps, simulated)
        return self._answer(len(params), fps, simulated)

    @property
    def _of_student(self) -> bool:
        if self.model != "auto" or self.run_folder.suffix.lower() == BUNDLE_SUFFIX:
            return self.model == "student" or self.run_folder.suffix.lower() == BUNDLE_SUFFIX
        of_template = self.out.suffix.lower() == ".glb" or self.colors != "scan" or bool(self.loose_parts)
        return not of_template and (self.run_folder / STUDENT).is_file()

    @property
    def _given_rate(self) -> float | None:
        """Return the motion's rate: that of the film times the frames of a step."""
        return None if self.fps is None else self.fps * self.step

    @property
    def _drawn(self) -> str:
        return "student" if self._of_student else "template"

    def _student_film(self) -> dict:
        """Draw the student frame by frame and write the film."""
        import avatar
        from avatar.runtime.skeleton import resampled, skeleton_body

        # The whole motion drives the clothes; `first` is the row of the first frame that is shown.
        bundle = avatar.open_bundle(self.run_folder)
        given = self.driving.load(self.params, skeleton_body(bundle), fps=self._given_rate)
        chosen, fps, whole = self._chosen(given)
        motion = replace(whole, fps=fps * self.step)
        first = len(whole) - 1 - (len(chosen) - 1) * self.step
        begin = range(len(given))[self.start : self.stop][0] - first
        shown = range(first, len(whole), self.step)
        # Resampling changes the numbers of rows: convert the first shown row through its time.
        if self.interpolate is not None:
            motion = resampled(motion, self.interpolate)
            shown = range(round(first / (fps * self.step) * self.interpolate), len(motion))
            fps = self.interpolate
        # Training codes hold for clothes as the field moved them, not for simulated ones.
        about = dict(bundle.garments_about)
        loose = about.get("garments", [])
        if self.floor is not None:
            about["simulation"] = {**about.get("simulation", {}), "floor": self.floor}
            bundle = replace(bundle, garments_about=about)
        simulated = [row["part"] for row in loose] if self.cloth == "simulate" else []
        if simulated and self.codes == "trained":
            received = f"simulated: {', '.join(simulated)}"
            raise InputError(
                "option codes trained", expected="clothes as training had them (--cloth field)", received=received
            )
        # Draw and write frame by frame; the number of cameras is that of the frames.
        film = StudentFilm(
            view=self.view,
            height=self.height,
            width=self.width,
            cloth=self.cloth,
            clamp=self.outside == "clamp",
            numbered_from=begin if self.codes == "trained" else None,
            relighting=self.lighting.relighting(),
            device=self.device,
        )
        cameras, frames = student_frames(bundle, motion, shown, film, self._notes, self._quality)
        shown_frames = track(
            frames, total=len(cameras), description="frames", console=Console(stderr=True), disable=self.json
        )
        write_film(self.out, shown_frames, fps=fps, size=(cameras[0].width, cameras[0].height))
        if not self.json:
            self._print(len(shown), fps, simulated)
        return self._answer(len(shown), fps, simulated)

    def _answer(self, frames: int, fps: float, simulated: list[str]) -> dict:
        checks = [check.as_dict() for check in all_checks(self._quality, "the film")]
        about = {"out": str(self.out), "frames": frames, "fps": fps, "simulated": simulated}
        return {**about, "checks": checks, "notes": self._notes}

    def _print(self, frames: int, fps: float, simulated: list[str]) -> None:
        """Print the result to standard output and the notes to standard error."""
        moved = f", simulated: {', '.join(simulated)}" if simulated else ""
        Console().print(f"{self.out}: {frames} frames at {fps:g} a second{moved}", markup=False)
        failed = [check for check in all_checks(self._quality, "the film") if check.status == "fail"]
        failures = [f"FAILED {one.name}: {one.value:.2f} {one.unit}, {one.gate}; {one.explanation}" for one in failed]
        for sentence in (*self._notes, *failures):
            Console(stderr=True).print(sentence, markup=False)

    def _check_options(self, suffix: str) -> None:
        # First the combinations of model and output, then each option's own range.
        if suffix == ".glb" and self._of_student:
            raise InputError(f"output {self.out}", expected=".mp4, .gif or a folder for a student", received=".glb")
        if suffix == ".glb" and self.lighting.environment is not None:
            raise InputError("option environment", expected="a film or pictures", received=f"output {self.out}")
        if self.cloth == "field" and not self._of_student:
            expected = "simulate or skin for the template, which has no field"
            raise InputError("option cloth", expected=expected, received="field", remedy="--model student has one")
        if self.device != "cpu" and not self._of_student:
            raise InputError("option device", expected="cpu, which draws the template", received=self.device)
        if self.loose_parts and self._of_student:
            expected = "none for a student, whose loose parts its training found"
            raise InputError("option loose-parts", expected=expected, received=" ".join(self.loose_parts))
        if self.codes == "trained" and (self.interpolate is not None or not self._of_student):
            raise InputError(
                "option codes trained",
                expected="a student, without --interpolate",
                received=f"the {self._drawn}, --interpolate {self.interpolate}",
            )
        if self.interpolate is not None:
            require_positive("option interpolate", self.interpolate)
            if self.step != 1 or not self._of_student:
                raise InputError(
                    "option interpolate",
                    expected="a student (--model student, or a bundle), without --step",
                    received=f"the {self._drawn}, --step {self.step}",
                )
        if suffix not in (*SUFFIXES, ".glb"):
            raise InputError(
                f"output {self.out}",
                expected=".mp4, .gif, .glb, or no suffix for a folder of PNG pictures",
                received=suffix,
            )
        # Pixels of a picture.
        smallest = 16
        require_at_least("option height", self.height, smallest)
        if self.width is not None:
            require_at_least("option width", self.width, smallest)
        require_at_least("option step", self.step, 1)
        if self.fps is not None:
            require_positive("option fps", self.fps)
        if suffix == FRAME_FOLDER and self.out.exists():
            # The folder is replaced as a whole: it must not hold anything but an earlier film.
            names = [p.name for p in self.out.iterdir()] if self.out.is_dir() else ["(a file)"]
            foreign = [name for name in names if not name.startswith("frame_")]
            if foreign:
                raise InputError(
                    f"output {self.out}",
                    expected="a new folder, or one that holds frames alone",
                    received=f"{foreign[0]} in it" if self.out.is_dir() else "a file",
                )

    def _chosen(self, params: BodyParams) -> tuple[BodyParams, float, BodyParams]:
        """Return the chosen frames, how many of them a second shows, and the motion up to the last of them.

        That has all frames, begins a moment before the first one, and is what loose clothes follow.
        """
        pre_roll = 0.7  # seconds of the motion before the first frame that loose clothes follow
        count = len(params)
        # Select the shown frames.
        chosen = range(count)[self.start : self.stop : self.step]
        if not len(chosen):
            raise InputError(
                "frames",
                expected=f"some of the {count} frames of {self.params.name}",
                received=f"--start {self.start} --stop {self.stop} --step {self.step}",
            )
        # A step of n frames shows 1/n of the rate, so that the motion keeps its speed.
        fps = self.fps or (params.fps or DEFAULT_FPS) / self.step
        # Clothes begin to move before the first shown frame, so that they swing there already.
        begin = max(0, chosen[0] - round(pre_roll * fps * self.step))
        whole = params.select(slice(begin, chosen[-1] + 1))
        return replace(params.select(list(chosen)), fps=fps), fps, whole

    def _garments(self, template: Template) -> list[Garment]:
        """Read the loose parts of the run, or cut those that were asked for."""
        if not self.loose_parts:
            path = self.run_folder / GARMENTS
            return load_garments(path, template) if path.is_file() else []
        reference = load_params_of_run(self.run_folder).frame(0).without_shape()
        return [cut_garment(template, part, reference) for part in self.loose_parts]

    def _posed(
        self, template: Template, garments: list[Garment], whole: BodyParams, chosen: BodyParams, fps: float
    ) -> Iterator[Float[np.ndarray, "V 3"]]:
        """Pose the chosen frames one by one."""
        if not garments:
            yield from _pose_blocks(template, chosen)
            return
        config = DriverConfig(floor=self.floor)
        notes, quality = self._notes, self._quality
        surfaces = play(template, garments, whole, fps=fps * self.step, config=config, notes=notes, quality=quality)
        first = len(whole) - 1 - (len(chosen) - 1) * self.step
        for k, vertices in enumerate(surfaces):
            if k >= first and (k - first) % self.step == 0:
                yield vertices

    def _cameras(self, template: Template, params: BodyParams) -> list[Camera]:
        """Place a camera a frame; it stands still, unless on a turntable, and sees the whole motion."""
        # Poses that the camera is fitted to.
        framing_poses = 24
        # Frame the camera by a sample of the poses, since posing all of a long motion is slow.
        some = spread(range(len(params)), framing_poses)
        points = template.pose(params.select(some)).reshape(-1, 3)
        height = self.height + self.height % 2  # h264 with 4:2:0 colour takes even sizes
        width = None if self.width is None else self.width + self.width % 2
        if self.view == "turntable":
            return turntable_cameras(points, count=len(params), height=height, width=width)
        return fit_cameras(points, directions=[VIEWS[self.view]], height=height, width=width) * len(params)

    def _frames(
        self, template: Template, posed: Iterator[Float[np.ndarray, "V 3"]], cameras: list[Camera]
    ) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        """Draw the pictures one after the other."""
        colors = {
            "scan": lambda: template.vertex_colors,
            "labels": lambda: template.labels.display_colors(template.vertex_labels),
            "semantic": lambda: template.semantic_colors,
            "weights": lambda: blend_joint_colors(template.weights),
            "none": lambda: None,
        }[self.colors]()
        relighting = self.lighting.relighting()
        # The colours contain the light already, so that the shading of the drawing is switched off.
        style = None if relighting is None else ShadeStyle(relief=0.0)
        # `strict` detects a motion whose number of frames differs from that of the cameras.
        pairs = zip(posed, cameras, strict=True)
        for vertices, camera in track(
            pairs, total=len(cameras), description="frames", console=Console(stderr=True), disable=self.json
        ):
            mesh, shown = template.mesh.with_vertices(vertices), colors
            if relighting is not None and colors is not None:
                lit = relighting.colors(colors / 255.0, mesh.vertex_normals)
                shown = np.round(255.0 * lit).astype(np.uint8)
            yield render_shaded(mesh, camera, vertex_colors=shown, style=style)


def _pose_blocks(template: Template, params: BodyParams) -> Iterator[Float[np.ndarray, "V 3"]]:
    """Pose frames in blocks of at most `_BLOCK`, so that long motions fit in memory."""
    for begin in range(0, len(params), _BLOCK):
        yield from template.pose(params.select(slice(begin, begin + _BLOCK)))
