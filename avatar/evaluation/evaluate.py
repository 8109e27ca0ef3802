"""Measure every model on the same views and true surfaces, and keep some pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from avatar.data.sequence import AvatarSequence, camera_centers_of
from avatar.data.views import View
from avatar.evaluation.protocol import (
    AsNew,
    Gallery,
    ProtocolConfig,
    ShownSurface,
    ShownView,
    ViewSet,
    new_pose,
    truth_frames,
    view_sets,
    with_people,
)
from avatar.evaluation.report import SKINNING_ALONE, EvalReport, ModelFigures, Surfaces, view_key
from avatar.evaluation.summary import SPREAD_CONVENTION
from avatar.gaussians.sampling import head_faces
from avatar.losses.perceptual import PerceptualDistance
from avatar.losses.perceptual_weights import load_metric
from avatar.metrics import speed, surface_quality, view_quality
from avatar.metrics.surface_quality import SAMPLES, SurfaceQuality, mean_surface
from avatar.metrics.view_quality import Box, ViewQuality, eight_bit, head_box, head_shown, head_vertices
from avatar.models.student import Student
from avatar.rendering.avatar_view import render_view
from avatar.rig.rig import AvatarModel, Pose, PosedAvatar, Rig, at_rest
from smplxpp.core import BodyParams, InputError, ProgressCallback, TriangleMesh, ignore_progress, require_at_least
from smplxpp.metrics.sampling import SurfaceSamples


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """Options of an evaluation: views, surfaces, speed and metrics.

    Attributes:
        protocol: choice of the views.
        metric: perceptual distance: "st-lpips", "lpips", "both" or "none".
        lpips_weights: files of LPIPS, see `load_lpips`.
        samples: points sampled on each surface; 0: no surface is measured.
        seed: of the samples.
        speed_size: width and height of the pictures that are timed.
        speed_pictures: number of timed pictures; 0: speed is not measured.
        shown: number of evenly spread views of each set whose pictures are kept beside the worst one; 0: none.
        eps2d: the rasteriser's blur, pixels squared, as in training.
    """

    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    metric: str = "st-lpips"
    lpips_weights: tuple[Path, ...] = ()
    samples: int = SAMPLES
    seed: int = 0
    speed_size: tuple[int, int] = (512, 512)
    speed_pictures: int = 20
    shown: int = 2
    eps2d: float = 0.1

    def __post_init__(self) -> None:
        for name in ("samples", "seed", "speed_pictures", "shown"):
            require_at_least(f"evaluation: {name}", getattr(self, name), 0)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The results of an evaluation: figures and pictures.

    Attributes:
        report: all figures.
        views: pictures of some views, in the order of sets.
        surfaces: posed meshes of one training frame and one held-out frame.
    """

    report: EvalReport
    views: tuple[ShownView, ...]
    surfaces: tuple[ShownSurface, ...]


def evaluate_models(
    models: Mapping[str, AvatarModel],
    sequence: AvatarSequence,
    config: EvaluationConfig | None = None,
    *,
    files: Mapping[str, Path] | None = None,
    progress: ProgressCallback = ignore_progress,
) -> Evaluation:
    """Measure models on a capture: images, surface, speed and size, all by the same rules.

    Every model poses a frame once, for all cameras of all sets and for the surface. Training frames use their own
    code where a model has codes; other frames are drawn as new poses. The head's boxes come from the sequence's
    template, whatever template a model has.

    Args:
        models: on the sequence's device, by their names in tables.
        sequence: the capture and the template of the person.
        files: of the models, for their bytes on disk.
        progress: called with the measured share of the frames.

    Raises:
        InputError: no model, a model on another device, no view to measure, frames without parameters.
    """
    config = config or EvaluationConfig()
    _check_models(models, sequence)
    # Decide everything before any model runs: bad files and empty sets end an evaluation at once, not after hours.
    sets = with_people(sequence.capture, view_sets(sequence.capture, config.protocol))
    truths = truth_frames(sequence.capture, config.protocol, sets) if config.samples else {}
    run = _Run(models, sequence, config, sets, truths)
    # One pass over all frames, because a pose and its surface serve every set that has the frame.
    frames = sorted({frame for one in sets.values() for frame in one.frames} | set(chain(*truths.values())))
    for done, frame in enumerate(frames):
        progress("frames", done / len(frames))
        run.measure(frame)
    progress("frames", 1.0)
    return run.result(files or {})


class _Run:
    """A running evaluation with its results so far."""

    def __init__(
        self,
        models: Mapping[str, AvatarModel],
        sequence: AvatarSequence,
        config: EvaluationConfig,
        sets: Mapping[str, ViewSet],
        truths: Mapping[str, tuple[int, ...]],
    ) -> None:
        self.models, self.sequence, self.config = models, sequence, config
        self.sets, self.truths = sets, truths
        # With both distances LPIPS has columns of its own, beside those of ST-LPIPS.
        both = config.metric == "both"
        self.metric = self._metric("st-lpips" if both else config.metric)
        self.lpips = self._metric("lpips") if both else None
        self.views: dict[str, dict[str, dict[str, ViewQuality]]] = {name: {s: {} for s in sets} for name in models}
        self.surfaces: dict[str, dict[int, SurfaceQuality]] = {name: {} for name in models}
        self.skinning_alone: dict[int, SurfaceQuality] = {}
        self.gallery = Gallery(sets, config.shown)
        self.meshes: dict[str, ShownSurface] = {}
        # The middle frame of each part shows the surfaces in pictures.
        self._middle = {frames[len(frames) // 2]: name for name, frames in truths.items()}
        self._head = torch.tensor(head_vertices(sequence.rig.template), device=sequence.device)
        self._head_faces: dict[int, Bool[np.ndarray, " F"] | None] = {}

    def _metric(self, name: str) -> PerceptualDistance | None:
        return load_metric(name, device=self.sequence.device, weights=self.config.lpips_weights)

    def measure(self, frame: int) -> None:
        """Measure all sets' views and the surface of one frame."""
        sequence = self.sequence
        # Cameras of this frame in all sets, each once: a view that two sets share is drawn once.
        cameras = list(dict.fromkeys(c for one in self.sets.values() for c, f in one.views if f == frame))
        views = [sequence.whole_view(camera, frame) for camera in cameras]
        # The skinned template places the head for all models alike, so that all are compared over the same pixels.
        skinned = sequence.rig.skin(sequence.pose(frame).without_cloth())
        corners = skinned[self._head].double().cpu().numpy()
        heads = [head_box(corners, view.camera) for view in views]
        shown = [self._head_shown(skinned, view) for view in views]
        # The true surface, and the baseline that needs no training: linear blend skinning of the template.
        truth = alone = points = None
        if any(frame in frames for frames in self.truths.values()):
            truth = sequence.capture.truth_mesh(frame)
            assert truth is not None  # `truth_frames` chose frames that have one
            mesh = _mesh(skinned, sequence.rig)
            points = surface_quality.points_of_truth(truth, samples=self.config.samples, seed=self.config.seed)
            alone = self.skinning_alone[frame] = self._surface(mesh, sequence.rig, truth, points)
            if frame in self._middle:
                part = self._middle[frame]
                self.meshes[part] = ShownSurface(part, frame, truth, {SKINNING_ALONE: mesh})
        # The mesh does not depend on the eye: a frame that has no view, but a surface, gets any centre.
        camera_centers = camera_centers_of(views) if views else skinned.new_zeros(1, 3)
        # Draw and compare every model, in its evaluation mode and without gradients.
        pictures: list[dict[str, UInt8[np.ndarray, "H W 3"]]] = [{} for _ in views]
        for name, model in self.models.items():
            with at_rest(model):
                posed = model(_pose(model, sequence, frame), camera_centers)
                for index, view in enumerate(views):
                    pictures[index][name] = self._see(name, posed, index, view, frame, (heads[index], shown[index]))
            # Models that deform nothing have the mesh of skinning, whose distances are known already.
            if truth is not None and alone is not None:
                if model.rig.template is sequence.rig.template and torch.equal(posed.vertices, skinned):
                    self.surfaces[name][frame] = alone
                    continue
                mesh = _mesh(posed.vertices, model.rig)
                self.surfaces[name][frame] = self._surface(mesh, model.rig, truth, points)
                if frame in self._middle:
                    self.meshes[self._middle[frame]].posed[name] = mesh
        for view, head, rendered in zip(views, heads, pictures, strict=True):
            self._show(view, frame, head, rendered)

    def result(self, files: Mapping[str, Path]) -> Evaluation:
        """Make the report of all frames, with speed and size."""
        # Means over frames are taken here, once all frames are measured.
        models = {
            name: ModelFigures(
                views=self.views[name],
                surfaces=self._by_set(self.surfaces[name]),
                speed=self._speed(model),
                parameters=speed.parameter_counts(model),
                bytes=speed.bytes_on_disk(files[name]) if name in files else None,
            )
            for name, model in self.models.items()
        }
        metric, lpips = (None if one is None else one.name for one in (self.metric, self.lpips))
        # A report states in words what each of its figures means.
        conventions = {
            "images": view_quality.CONVENTION,
            "spread": SPREAD_CONVENTION,
            **{name: view_quality.PERCEPTUAL_CONVENTION for name in (metric, lpips) if name is not None},
            **({"surface": surface_quality.CONVENTION} if self.truths else {}),
            **({"speed": speed.CONVENTION} if self.config.speed_pictures else {}),
        }
        alone = self._by_set(self.skinning_alone)
        report = EvalReport(self.sequence.capture.name, metric, models, alone, conventions, lpips=lpips)
        return Evaluation(report, self.gallery.views(), tuple(self.meshes[name] for name in self.truths))

    def _head_shown(self, skinned: Float[Tensor, "V 3"], view: View) -> Bool[Tensor, "H W"] | None:
        """Return the pixels that show the head of the skinned template; None for a body without a head."""
        rig = self.sequence.rig
        head = self._faces_of_head(rig)
        return None if head is None else head_shown(_mesh(skinned, rig), head, view.camera).to(rig.device)

    def _faces_of_head(self, rig: Rig) -> Bool[np.ndarray, " F"] | None:
        """Return `_faces_of_head` of a rig, found once."""
        if id(rig) not in self._head_faces:
            self._head_faces[id(rig)] = _faces_of_head(rig)
        return self._head_faces[id(rig)]

    def _see(
        self,
        name: str,
        posed: PosedAvatar,
        index: int,
        view: View,
        frame: int,
        head: tuple[Box | None, Bool[Tensor, "H W"] | None],
    ) -> UInt8[np.ndarray, "H W 3"]:
        """Draw one view of a model and compare it, for every set that has the view; return the picture."""
        background = self.sequence.background
        drawn = render_view(posed, index, view, background, eps2d=self.config.eps2d)
        quality = view_quality.view_quality(
            view,
            drawn.image,
            drawn.alpha,
            background,
            head=head[0],
            head_pixels=head[1],
            metric=self.metric,
            lpips=self.lpips,
        )
        for part in self._sets_of(view, frame):
            self.views[name][part][view_key(view.name, frame)] = quality
        return eight_bit(drawn.image).numpy()

    def _show(self, view: View, frame: int, head: Box | None, rendered: dict[str, UInt8[np.ndarray, "H W 3"]]) -> None:
        """Offer a view that all models have drawn to the gallery."""
        truth = eight_bit(view.composited(self.sequence.background)).numpy()
        last = list(self.models)[-1]
        for part in self._sets_of(view, frame):
            psnr = self.views[last][part][view_key(view.name, frame)].psnr
            self.gallery.pass_by(ShownView(part, view.name, frame, truth, rendered, head), psnr)

    def _sets_of(self, view: View, frame: int) -> list[str]:
        return [part for part, one in self.sets.items() if (view.name, frame) in one.views]

    def _surface(
        self, mesh: TriangleMesh, rig: Rig, truth: TriangleMesh, of_truth: SurfaceSamples | None
    ) -> SurfaceQuality:
        return surface_quality.surface_quality(
            mesh,
            rig.template.vertex_labels,
            truth,
            head=self._faces_of_head(rig),
            samples=self.config.samples,
            seed=self.config.seed,
            labels=rig.template.labels,
            of_truth=of_truth,
        )

    def _by_set(self, frames: Mapping[int, SurfaceQuality]) -> dict[str, Surfaces]:
        parts = {name: {f: frames[f] for f in chosen} for name, chosen in self.truths.items()}
        return {name: Surfaces(mean_surface(list(part.values())), part) for name, part in parts.items()}

    def _speed(self, model: AvatarModel) -> speed.Speed | None:
        """Time pictures of the first set's first camera, through the poses of that set."""
        if not self.config.speed_pictures:
            return None
        # Speed depends on the picture's size and the number of Gaussians, so that one camera and one set suffice.
        capture, first = self.sequence.capture, next(iter(self.sets.values()))
        return speed.measure_speed(
            model,
            [_params(self.sequence, frame) for frame in first.frames],
            capture.cameras[first.views[0][0]],
            size=self.config.speed_size,
            pictures=self.config.speed_pictures,
            eps2d=self.config.eps2d,
        )


def _params(sequence: AvatarSequence, frame: int) -> BodyParams:
    """Return the parameters of a measured frame."""
    params = sequence.capture.params(frame)
    assert params is not None  # `view_sets` refused frames without them, `truth_frames` left them out
    return params


def _faces_of_head(rig: Rig) -> Bool[np.ndarray, " F"] | None:
    """Return the mask of the faces of the template's head; None for a body without a head."""
    try:
        return head_faces(rig.template)
    except InputError:
        return None


def _mesh(vertices: Float[Tensor, "V 3"], rig: Rig) -> TriangleMesh:
    return TriangleMesh(vertices.double().cpu().numpy(), rig.template.faces)


def _pose(model: AvatarModel, sequence: AvatarSequence, frame: int) -> Pose:
    """Return a frame's pose for a model's own template, with simulated clothes for students with a field alone."""
    # A model with a template of its own (a baseline's) is posed by its own rig, where no garments are simulated.
    pose = new_pose(sequence, frame) if isinstance(model, AsNew) else sequence.pose(frame)
    if model.rig.template is sequence.rig.template:
        return pose if simulates(model) else pose.without_cloth()
    return model.rig.pose(_params(sequence, frame), frame=pose.frame)


def simulates(model: AvatarModel) -> bool:
    """Return whether a model's loose clothes are simulated: those of students with a field, which it replaces.

    Students without a field are the baseline for the simulation, because their Gaussians follow the joints alone.
    """
    shown = model.model if isinstance(model, AsNew) else model
    return isinstance(shown, Student) and shown.field is not None


def _check_models(models: Mapping[str, AvatarModel], sequence: AvatarSequence) -> None:
    if not models:
        raise InputError(
            "models to evaluate",
            expected="at least one",
            received="none",
            remedy="train one with `smplxpp train RUN --capture DIR`",
        )
    for name, model in models.items():
        if model.rig.device != torch.device(sequence.device):
            raise InputError(f"model {name}", expected=f"on {sequence.device}", received=f"on {model.rig.device}")
