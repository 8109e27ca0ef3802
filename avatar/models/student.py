"""The student: Gaussians on a mesh that a small field displaces, with blend shapes for the residual."""

from __future__ import annotations

import copy
import dataclasses
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.gaussians import BoundGaussians, head_faces, triangle_frames, view_colors, world_from_frames
from avatar.models.learned_gaussians import LearnedGaussians
from avatar.models.networks.blend_shapes import BlendShapeConfig, BlendShapes
from avatar.models.networks.control_points import choose_control_points, template_control_points
from avatar.models.networks.deformation_field import DeformationField, FieldConfig, FrameCodes
from avatar.models.networks.pose_dependence import PoseGate, PoseRegression, seen_joints
from avatar.rendering.on_device import record_graph
from avatar.rig.rig import Pose, PosedAvatar, Rig
from smplxpp.cloth.garment import Garment
from smplxpp.core import ARRAY_NAMES, BodyParams, InputError, require_at_least

if TYPE_CHECKING:
    from avatar.models.fused_kernels import FusedField, FusedGaussians

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StudentConfig:
    """Architecture of a student. The defaults are the paper's.

    Attributes:
        field: of the mesh's displacements; None: the mesh follows its joints alone.
        blend_shapes: of the Gaussians; None, as before the compensation: none.
        control_points: number of vertices on which the field is evaluated and from which it is interpolated; 0: all.
        still_body: the field displaces clothes, shoes and hair alone; the body's own surface follows its joints. Not
            applied to a template that is a body alone.
    """

    field: FieldConfig | None = dataclasses.field(default_factory=FieldConfig)
    blend_shapes: BlendShapeConfig | None = None
    control_points: int = 0
    still_body: bool = False

    def __post_init__(self) -> None:
        require_at_least("student control_points", self.control_points, 0)


@dataclass(frozen=True, kw_only=True)
class StudentOrigin:
    """Name, garments and reference pose of a student, which bundles and other exported files contain too.

    Attributes:
        name: name of the avatar.
        garments: loose clothes, which players simulate.
        reference: parameters, without shape, that pose the template as its scan; None: not known.
        digests: SHA-256 of the files that the student was opened from, by name.
    """

    name: str = "avatar"
    garments: tuple[Garment, ...] = ()
    reference: BodyParams | None = None
    digests: Mapping[str, str] = dataclasses.field(default_factory=dict)


class Student(nn.Module):
    """Template, field, frame codes, Gaussians and blend shapes as one avatar (an `AvatarModel`).

    `v = v_rest + S(v, theta, z_t)` is skinned, Gaussians hang on its triangles, and the blend shapes add
    `du = U z` to their offsets and `dc = C z` to their colours.

    Args:
        config: architecture.
        rig: of the template.
        gaussians: bound to the template.
        frames: numbers of the frames that have a code.
        blend_shapes: of these Gaussians; None makes new ones where the configuration has them.
        known_poses: theta of the training frames, radians; far from them the body's blend shapes fade. None: they do
            not fade.
        regression: displacements of the field's points in poses without a code; None: the field with the null code.

    Attributes:
        fps: of the training frames, a second; None: not known.
    """

    fps: float | None = None

    def __init__(
        self,
        config: StudentConfig,
        rig: Rig,
        gaussians: BoundGaussians,
        frames: tuple[int, ...],
        *,
        blend_shapes: BlendShapes | None = None,
        known_poses: Float[Tensor, "T 63"] | None = None,
        regression: PoseRegression | None = None,
    ) -> None:
        super().__init__()
        gaussians.check_topology(rig.faces, "template of the student")
        # Field and codes move the mesh; Gaussians and blend shapes hang on it.
        self.config, self.rig, self.origin = config, rig, StudentOrigin()
        self.gaussians = LearnedGaussians(gaussians)
        self.field = None if config.field is None else _make_field(config.field, config, rig)
        self.codes = None if config.field is None else FrameCodes(frames, config.field.code_size)
        if blend_shapes is None and config.blend_shapes is not None:
            blend_shapes = make_blend_shapes(config.blend_shapes, rig, gaussians)
        self.blend_shapes = blend_shapes
        self.pose_gate = None if known_poses is None else PoseGate(known_poses)
        points = 0 if self.field is None else len(self.field.points)
        if regression is not None and len(regression.level) != points:
            raise InputError(
                "regression of new poses",
                expected=f"one of the field's {points} points",
                received=f"one of {len(regression.level)}",
            )
        self.regression = regression
        self.to(rig.device)

    @property
    def frames(self) -> tuple[int, ...]:
        """Numbers of the frames that have a code."""
        return () if self.codes is None else self.codes.frames

    def displacements(self, pose: Pose) -> Float[Tensor, "V 3"] | None:
        """Return the field's displacements in a pose, metres, the regression's in a new one; None without a field."""
        if self.field is None or self.codes is None:
            return None
        # A training frame uses its own code. Another pose is predicted by the regression, or by the field's null
        # code.
        frame = pose.frame if pose.frame in self.codes.row else None
        if frame is None and self.regression is not None:
            return self.field.spread(self.regression(pose.body_pose[None].to(self.regression.level.dtype)))[0]
        return self.field(pose.body_pose[None].to(self.codes.codes.dtype), self.codes([frame]))[0]

    def compensated(self, pose: Pose) -> BoundGaussians:
        """Return the Gaussians with their blend shapes of a pose added."""
        bound = self.gaussians()
        if self.blend_shapes is None:
            return bound
        of_head, of_body = self.shape_coefficients(self.blend_shapes, pose)
        if pose.cloth is None:
            du, dc = self.blend_shapes(of_head + of_body)
        else:  # body shapes were learned on the tracked surface and do not hold on simulated clothes
            still = (1.0 - pose.cloth.share[self.rig.faces[bound.face_index]].mean(dim=1))[None]
            du, dc = (
                a + still * b for a, b in zip(self.blend_shapes(of_head), self.blend_shapes(of_body), strict=True)
            )
        return replace(bound, offset=bound.offset + du[0].to(bound.offset), dc=bound.dc + dc[0].to(bound.dc))

    def shape_coefficients(
        self, shapes: BlendShapes, pose: Pose
    ) -> tuple[Float[Tensor, "1 P n"], Float[Tensor, "1 P n"]]:
        """Return the coefficients of the head's shapes and of the body's in a pose, each 0 for the other's shapes."""
        # Coefficients z (1, P, n) of this pose: the first `head_shapes` belong to the head, the rest to the body.
        expression, theta, jaw = (one[None].to(shapes.U.dtype) for one in (pose.expression, pose.body_pose, pose.jaw))
        z = shapes.coefficients(expression, theta, jaw if shapes.config.jaw else None)
        # Body shapes fade in unseen poses and under simulated clothes; head shapes do not.
        head = shapes.config.head_shapes
        of_head, of_body = z.clone(), self._pose_weight(pose) * z
        of_head[..., head:], of_body[..., :head] = 0.0, 0.0
        return of_head, of_body

    def _pose_weight(self, pose: Pose) -> float | Tensor:
        """Return the weight of a pose as one of the training's, in [0, 1]; body shapes fade with it."""
        if pose.known is not None:
            return pose.known
        if self.pose_gate is None or pose.frame in self.frames:
            return 1.0
        return self.pose_gate(pose.body_pose)

    def forward(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Pose the student as cameras with these centres, metres, see it."""
        # The field's displacements in the rest pose, with a simulation's where there is one; then linear blend
        # skinning.
        displacements = self.rig.displaced(pose, self.displacements(pose))
        vertices = self.rig.skin(pose.without_cloth(), displacements)
        frames = triangle_frames(vertices, self.rig.faces)
        # Gaussians in the frames of the posed triangles, then in the world.
        bound = self.compensated(pose)
        world = world_from_frames(bound, frames)
        # Viewing directions are constants: a colour's gradient must not move its Gaussian.
        colors = view_colors(bound, frames, world.means.detach(), camera_centers)
        return PosedAvatar(vertices, world, colors, bound, displacements)

    def with_blend_shapes(
        self,
        blend_shapes: BlendShapes | BlendShapeConfig | None,
        *,
        known_poses: Float[Tensor, "T 63"] | None = None,
    ) -> Student:
        """Return a copy of the student with other blend shapes; a configuration makes new ones that start at zero.

        Args:
            blend_shapes: the new ones, their configuration, or None for none.
            known_poses: theta of the poses near which body shapes act; None: those of this student.
        """
        # A copy with the new blend shapes and the same Gaussians, gate and regression.
        given = blend_shapes if isinstance(blend_shapes, BlendShapes) else None
        shapes_config = blend_shapes.config if isinstance(blend_shapes, BlendShapes) else blend_shapes
        other = Student(
            replace(self.config, blend_shapes=shapes_config),
            self.rig,
            self.gaussians(),
            self.frames,
            blend_shapes=given,
            known_poses=self.pose_gate.poses if known_poses is None and self.pose_gate is not None else known_poses,
            regression=copy.deepcopy(self.regression),
        )
        # Copy field and codes.
        for mine, its in ((self.field, other.field), (self.codes, other.codes)):
            if mine is not None and its is not None:
                its.load_state_dict(mine.state_dict())
        if self.codes is not None and other.codes is not None:
            other.codes.null_code_shown = self.codes.null_code_shown
        other.origin, other.fps = self.origin, self.fps
        return other

    def export(self, path: str | Path, **options: Any) -> dict[str, Any]:
        """Write the student for players and other programs, as `avatar.export_student` does.

        Args:
            path: its suffix says what is written: `.avatar` (a bundle for our players), `.ply .spz .sog .glb` (splats
                of a pose), `.usdc` (splats that move), `.onnx` (the step from a pose to splats).
            options: see `avatar.export_student`.

        Example:
            >>> student.export("me.avatar")
            >>> student.export("me.ply", params=params.frame(0))
        """
        import avatar  # the writers lie above this room; the front door knows where

        return avatar.export_student(self, path, **options)

    def compiled(
        self, *, dtype: torch.dtype = torch.float32, graph: bool = True, fused: bool = False
    ) -> CompiledStudent:
        """Return the student as it is for films and streams of new poses on a GPU, see `CompiledStudent`."""
        return CompiledStudent(self, dtype=dtype, graph=graph, fused=fused)


class CompiledStudent:
    """A student in new poses as one CUDA graph: parameters in, the avatar as one camera sees it out.

    Pose, field, blend shapes, skinning and colours are computed on the student's device from one small copy a frame.
    On a GPU they are recorded once and replayed; where that fails, which is logged, and on a CPU, they run as they are.
    Loose clothes are not simulated: they follow the student's field.

    Args:
        student: whose parameters must not change any more.
        dtype: of field and blend shapes; geometry and colours stay in float32.
        graph: record a CUDA graph on a GPU.
        fused: use the Triton kernels of `fused_kernels`, which were tried on a CPU by Triton's interpreter alone. Their
            first pose is compared with torch's; where they fail or differ, which is logged, torch computes.

    Example:
        >>> fast = student.compiled(dtype=torch.float16)
        >>> picture = avatar.render_view(fast(params.frame(0), camera.position), 0, camera, background)
    """

    def __init__(
        self, student: Student, *, dtype: torch.dtype = torch.float32, graph: bool = True, fused: bool = False
    ) -> None:
        self.rig, self.student = student.rig, copy.copy(student)
        # Copies of what computes in another precision; the rest is shared.
        self.student._modules = dict(student._modules)
        for name in ("field", "codes", "regression", "blend_shapes"):
            part = getattr(student, name)
            if part is not None and dtype != torch.float32:
                self.student._modules[name] = copy.deepcopy(part).to(dtype)
        self._dtype, self._kernels = dtype, self._fused_kernels() if fused else None
        self._graph = graph and self.rig.device.type == "cuda"
        self._replay: tuple[Callable[[], object], PosedAvatar] | None = None
        self._widths: dict[str, int] = {}
        self._flat = False

    @property
    def fused(self) -> bool:
        """Whether Triton's kernels compute; known after the first pose."""
        return self._kernels is not None

    @property
    def recorded(self) -> bool:
        """Whether poses are replayed as a CUDA graph; known after the first one."""
        return self._replay is not None

    @torch.no_grad()
    def __call__(self, params: BodyParams, camera_center: Float[np.ndarray, " 3"]) -> PosedAvatar:
        """Return the avatar in a pose; on a GPU in memory that the next pose overwrites.

        Args:
            params: one frame; its shape coefficients are ignored.
            camera_center: centre of projection in the world, metres.

        Raises:
            InputError: several frames, parameters of another body, or of other widths than those of the first call.
        """
        if len(params) != 1:
            raise InputError("parameters of a pose", expected="one frame", received=f"{len(params)} frames")
        given = {name: getattr(params, name)[0] for name in ARRAY_NAMES if name != "betas"}
        missing = max(0, self.rig.expression_size - len(given["expression"]))
        given["expression"] = np.pad(given["expression"], (0, missing))
        widths = {name: len(value) for name, value in given.items()}
        if self._widths and (widths, params.flat_hand_mean) != (self._widths, self._flat):
            raise InputError("parameters of a pose", expected=f"{self._widths}, as before", received=str(widths))
        packed = torch.tensor(np.concatenate([*given.values(), camera_center]), dtype=torch.float32)
        if not self._widths:
            self._widths, self._flat = widths, params.flat_hand_mean
            self._input = packed.to(self.rig.device)
            self._compare_kernels()
            self._replay = record_graph(self._posed, subject="the student") if self._graph else None
        self._input.copy_(packed)
        if self._replay is None:
            return self._posed()
        self._replay[0]()
        return self._replay[1]

    def _posed(self) -> PosedAvatar:
        """Compute the pose of the input, without copies from the CPU and without waiting for the device."""
        *values, center = self._input.split([*self._widths.values(), 3])
        tensors = {name: value[None] for name, value in zip(self._widths, values, strict=True)}
        pose = self.rig.pose_on_device(tensors, flat_hand_mean=self._flat)
        field, codes, of_field = self.student.field, self.student.codes, self._kernels and self._kernels[0]
        if field is not None and codes is not None and of_field is not None:
            points = of_field.at_points(pose.body_pose[None].to(codes.codes.dtype), codes([None]))
            found: Tensor | None = field.spread(points)[0]
        else:
            found = self.student.displacements(pose)
        moved = None if found is None else found.float()
        vertices = self.rig.skin(pose, moved)
        if self._kernels is not None:
            shapes = self.student.blend_shapes
            z = None if shapes is None else torch.cat(self.student.shape_coefficients(shapes, pose)).sum(0)
            world, bound, colors = self._kernels[1](vertices, z, center)
            return PosedAvatar(vertices, world, colors, bound, moved)
        frames = triangle_frames(vertices, self.rig.faces)
        bound = self.student.compensated(pose)
        world = world_from_frames(bound, frames)
        return PosedAvatar(vertices, world, view_colors(bound, frames, world.means, center[None]), bound, moved)

    def _fused_kernels(self) -> tuple[FusedField | None, FusedGaussians]:
        """Return the kernels of the field, unless a regression stands for it, and of the Gaussians."""
        from avatar.models.fused_kernels import FusedField, FusedGaussians  # compiles on import, where Triton is

        made = self.student
        field = None if made.field is None or made.regression is not None else FusedField(made.field)
        return field, FusedGaussians(made.gaussians(), self.rig.faces, made.blend_shapes)

    def _compare_kernels(self) -> None:
        """Leave the kernels out if they fail, or if a pose by them is not that of torch."""
        if self._kernels is None:
            return
        # Metres and shares of a colour: of float32's roundings, and of half precision, whose sums torch rounds, too.
        kernels, apart = self._kernels, 1e-4 if self._dtype == torch.float32 else 1e-3
        try:
            found = self._posed()
            self._kernels = None
            truth = self._posed()
            pairs = ((found.gaussians.means, truth.gaussians.means), (found.colors, truth.colors))
            worst = max(float((a - b).abs().max()) for a, b in pairs)
            if not worst <= apart:
                raise RuntimeError(f"its Gaussians differ by {worst:.2g}")
            self._kernels = kernels
        except Exception as error:  # noqa: BLE001  whatever a compiler raises, torch computes the pose
            self._kernels = None
            log.warning("the student is not posed by Triton's kernels: %s", str(error).split("\n")[0][:300])


def _make_field(config: FieldConfig, student: StudentConfig, rig: Rig) -> DeformationField:
    control = template_control_points(rig.template, student.control_points) if student.control_points else None
    steps = config.local_pose
    seen = torch.tensor(seen_joints(rig.template, steps), device=rig.device) if steps else None
    still = rig.body_mask if student.still_body and not rig.body_mask.all() else None
    return DeformationField(config, rig.vertices, rig.cloth_mask, control=control, seen=seen, still=still)


def make_blend_shapes(config: BlendShapeConfig, rig: Rig, gaussians: BoundGaussians) -> BlendShapes:
    """Make blend shapes at zero for Gaussians on a template: parts by place, head weights by the head's faces."""
    part = head_weight = None
    if config.parts > 1:
        # Parts are the regions nearest to control points, chosen on the triangles' centres (metres, T-pose) of one
        # body part.
        centers = rig.template.mesh.triangles.mean(axis=1)[gaussians.face_index.cpu().numpy()]
        groups = rig.template.vertex_part[rig.template.faces[gaussians.face_index.cpu().numpy(), 0]]
        control = choose_control_points(centers, groups, count=config.parts, neighbour_count=1)
        part = torch.tensor(control.neighbours[:, 0])
    if config.gated:
        # 1 for Gaussians on the head, which the head's shapes may move, 0 for all others.
        on_head = head_faces(rig.template)[gaussians.face_index.cpu().numpy()]
        head_weight = torch.tensor(on_head, dtype=torch.float32)
    return BlendShapes(config, len(gaussians), part=part, head_weight=head_weight)
