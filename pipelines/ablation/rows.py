"""Define the rows of the ablation and the stages that make their models."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from avatar.baselines.avatar_base import PhotographConfig
from avatar.baselines.point_mlp import PointMLPConfig
from avatar.baselines.textured_mesh import TexturedMeshConfig
from avatar.baselines.uv_unet import UVUNetConfig
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.student import StudentConfig
from avatar.training.loose_clothes import ClothConfig
from avatar.training.presets import LOCAL_PARTS, TrainingPreset, with_local_shapes
from avatar.training.student.bake import BakeConfig
from pipelines.ablation.stages import BaselineStage, PruneConfig, PrunedStage
from pipelines.runs.layout import ABLATION, BAKE_STAGE, CLOTH_STAGE, COMPENSATE_STAGE, FIT_STAGE, TEACHER_STAGE
from pipelines.stages.bake import BakeStage
from pipelines.stages.cloth import ClothStage
from pipelines.stages.compensate import CompensateStage
from pipelines.stages.fit import FitStage
from pipelines.stages.models import CLOTHED, NAKED, OUTER, ModelStage
from pipelines.stages.teacher import TeacherStage
from smplxpp.core.errors import InputError

# Settings of single rows: share of Gaussians with blend shapes and size limit (MB) of `pruned`, field vertices of
# `control`, and the share of poses without codes in rows that need them (the lean presets' value).
PRUNED_SHARE, PRUNED_MEGABYTES = 0.3, 20.0
CONTROL_POINTS = 400
NULL_SHARE = 0.2


@dataclass(frozen=True)
class Row:
    """Definition of a line of the table.

    Attributes:
        title: title in tables.
        model: stage that makes the measured model.
        note: how it differs from the full system.
        null_code: whether every frame is shown as a new pose.
    """

    title: str
    model: str
    note: str
    null_code: bool = False


PAPER_ROWS: Mapping[str, Row] = {
    "naked": Row("w SMPLX", "naked", "the whole pipeline on the naked body"),
    "no-mesh": Row(
        "w/o Mesh Non.",
        "no_field",
        "no field: the mesh follows its joints alone, Gaussians learn from the teacher",
    ),
    "no-gaussians": Row("w/o Gau Non.", "bake", "the baked student without blend shapes"),
    "no-teacher": Row("w/o Teacher", "no_teacher", "field and attributes learn from photographs alone, by L_rec"),
    "full": Row("Full", "full", "teacher, bake, blend shapes"),
}
OPTION_ROWS: Mapping[str, Row] = {
    "no-tracking": Row("w/o tracking", "untracked", "the teacher starts from zero residuals, as in the paper"),
    "local": Row("local blend shapes", "local", f"{LOCAL_PARTS} parts of the Gaussians with coefficients of their own"),
    "pruned": Row(
        "pruned",
        "pruned",
        f"Full; {PRUNED_SHARE:.0%} of the Gaussians keep blend shapes, in {PRUNED_MEGABYTES:g} MB",
    ),
    "control": Row("control points", "control", f"the field on {CONTROL_POINTS} vertices, interpolated to the rest"),
    "ungated": Row("ungated", "ungated", "all blend shapes act on all Gaussians, as published"),
    "no-cloth": Row("w/o simulation", "no_cloth", "the field moves loose clothes in new poses too"),
    "null-code": Row("null code", "null_code", "every frame shown as a new pose, as online", null_code=True),
}
BASELINE_ROWS: Mapping[str, Row] = {
    "lbs": Row("LBS Gaussians", "lbs", "Gaussians on the template, which follows its joints alone; photographs"),
    "lbs-naked": Row("LBS Gaussians, naked", "lbs_naked", "the same on the naked body"),
    "mlp": Row("position MLP", "mlp", "residuals from a network on canonical positions (3DGS-Avatar's kind)"),
    "uv": Row("UV U-Net, naked", "uv", "residuals from a U-Net on the naked body's UV map (GaussianAvatar's kind)"),
    "outer": Row("teacher, outer surface", "outer_teacher", "one surface, no labels (Animatable Gaussians' kind)"),
    "mesh": Row("textured mesh", "mesh", "field and texture, no Gaussian leaves the surface (MeshAvatar's kind)"),
}
ROW_GROUPS: Mapping[str, Mapping[str, Row]] = {
    "paper": PAPER_ROWS,
    "options": OPTION_ROWS,
    "baselines": BASELINE_ROWS,
}
ROWS: Mapping[str, Row] = {name: row for group in ROW_GROUPS.values() for name, row in group.items()}


def ablation_rows(names: Sequence[str]) -> dict[str, Row]:
    """Return rows by their names and group names ("paper", "options", "all"), in the table's order.

    Raises:
        InputError: an unknown name, or none.
    """
    chosen: set[str] = set()
    for name in names:
        if name in ROWS:
            chosen.add(name)
        elif name in ROW_GROUPS or name == "all":
            chosen |= set(ROWS if name == "all" else ROW_GROUPS[name])
        else:
            raise InputError("ablation rows", expected=f"among {', '.join([*ROW_GROUPS, 'all', *ROWS])}", received=name)
    if not chosen:
        raise InputError("ablation rows", expected="at least one", received="none")
    return {name: row for name, row in ROWS.items() if name in chosen}


def ablation_stages(preset: TrainingPreset, *, training_frames: int) -> dict[str, ModelStage]:
    """Return every stage that rows may need, by name; the preset gives all sizes and iterations.

    Stages of the full system may be in the run already, from `smplxpp train`.

    Args:
        preset: preset of the training.
        training_frames: number of training frames, which determines the iterations of the bake without a teacher.
    """
    plan = _Plan(preset)
    plan.full_system(training_frames)
    plan.options()
    plan.baselines()
    return plan.stages


class _Plan:
    """Collect stages by name, each made from earlier ones."""

    def __init__(self, preset: TrainingPreset) -> None:
        self.preset, self.student = preset, preset.student()
        self.stages: dict[str, ModelStage] = {}

    @property
    def teacher(self) -> TeacherStage:
        """Return the teacher of the full system."""
        stage = self.stages["teacher"]
        assert isinstance(stage, TeacherStage)
        return stage

    def full_system(self, training_frames: int) -> None:
        """Add the stages of the paper's rows."""
        preset = self.preset
        # The full system and the row of the naked body have the same stages on different templates. The full system's
        # may stand in the run already (`elsewhere`), and are taken from there.
        for ground, prefix in ((CLOTHED, ""), (NAKED, "naked_")):
            own = {} if prefix else {"fit": (FIT_STAGE,), "teacher": (TEACHER_STAGE,), "bake": (BAKE_STAGE,)}
            self._add(
                FitStage(
                    name=_folder(f"{prefix}gaussians"),
                    ground=ground,
                    config=preset.fit,
                    elsewhere=own.get("fit", ()),
                )
            )
            self._add(
                TeacherStage(
                    name=_folder(f"{prefix}teacher"),
                    ground=ground,
                    gaussians=self.stages[f"{prefix}gaussians"],
                    networks=preset.networks.teacher,
                    config=preset.teacher,
                    elsewhere=own.get("teacher", ()),
                )
            )
            if ground == CLOTHED:
                teacher = self.teacher
                self._add(
                    ClothStage(name=_folder("cloth"), teacher=teacher, config=ClothConfig(), elsewhere=(CLOTH_STAGE,))
                )
            self._bake(f"{prefix}bake", f"{prefix}teacher", ground=ground, elsewhere=own.get("bake", ()))
        self._compensate("full", "bake", elsewhere=(COMPENSATE_STAGE,))
        self._compensate("naked", "naked_bake", ground=NAKED, teacher="naked_teacher")
        # Without field the mesh moves by skinning alone; attributes and blend shapes learn as always.
        self._bake("no_field_bake", student=replace(self.student, field=None, control_points=0))
        self._compensate("no_field", "no_field_bake")
        # Without teacher the bake learns from photographs, in as many views as the rows with a teacher see in all.
        steps = _without_teacher(preset, training_frames)
        self._bake("no_teacher_bake", "gaussians", config=replace(preset.bake, iterations=steps))
        self._compensate("no_teacher", "no_teacher_bake", teacher=None)

    def options(self) -> None:
        """Add the stages of our own variants."""
        preset, teacher = self.preset, self.preset.teacher
        if teacher.track is None:
            self.stages["untracked"] = self.stages["full"]
        else:
            # The start of the paper: zero residuals, without tracking and without pretraining on a tracked surface.
            from_zero = replace(teacher, track=None, joint=None, pretrain=None)
            self._add(replace(self.teacher, name=_folder("untracked_teacher"), config=from_zero, elsewhere=()))
            self._bake("untracked_bake", "untracked_teacher")
            self._compensate("untracked", "untracked_bake", teacher=None)
        # Blend shapes with coefficients for each small part of the Gaussians, and shapes that are not divided
        # into those of the head and those of the body.
        self._compensate("local", "bake", shapes=with_local_shapes(preset.blend_shapes))
        self._compensate("ungated", "bake", shapes=replace(preset.blend_shapes, gated=False))
        self._bake("no_cloth_bake", cloth=None)
        self._compensate("no_cloth", "no_cloth_bake")
        self._add(
            PrunedStage(
                name=_folder("pruned"),
                student=self.stages["full"],
                config=PruneConfig(keep=PRUNED_SHARE, max_bytes=1e6 * PRUNED_MEGABYTES),
            )
        )
        self._bake("control_bake", student=replace(self.student, control_points=CONTROL_POINTS))
        self._compensate("control", "control_bake")
        # The null code stands for poses without a frame. Presets that train with it have this row in their full system.
        if preset.bake.null_share and preset.compensate.null_share:
            self.stages["null_code"] = self.stages["full"]
        else:
            share = max(preset.bake.null_share, NULL_SHARE)
            self._bake("null_code_bake", config=replace(preset.bake, null_share=share))
            self._compensate("null_code", "null_code_bake", null_share=NULL_SHARE)

    def baselines(self) -> None:
        """Add avatars of other kinds, with as many steps on photographs as the student's bake and compensation."""
        preset = self.preset
        steps = preset.bake.iterations + preset.compensate.iterations
        own = {f.name: getattr(preset.bake, f.name) for f in fields(PhotographConfig)}
        photographs = replace(PhotographConfig(**own), iterations=steps)
        fixed, skinned = StudentConfig(field=None), replace(preset.bake, iterations=steps)
        self._bake("lbs", "gaussians", student=fixed, config=skinned)
        self._bake("lbs_naked", "naked_gaussians", ground=NAKED, student=fixed, config=skinned)
        # Half the size of the teacher's maps, because charts of an atlas waste less of it than two views of a body.
        unet = UVUNetConfig(size=preset.networks.teacher.out_size // 2)
        mesh = TexturedMeshConfig(preset.networks.field, preset.fit.sampling)
        for name, ground, model, config in (
            ("mlp", CLOTHED, PointMLPConfig(), photographs),
            ("uv", NAKED, unet, photographs),
            ("mesh", CLOTHED, mesh, replace(photographs, attributes=0.0)),
        ):
            gaussians = self.stages["gaussians" if ground == CLOTHED else "naked_gaussians"]
            self._add(BaselineStage(name=_folder(name), ground=ground, gaussians=gaussians, model=model, config=config))
        outer = replace(self.stages["gaussians"], name=_folder("outer_gaussians"), ground=OUTER, elsewhere=())
        self._add(outer)
        self._add(
            replace(
                self.teacher,
                name=_folder("outer_teacher"),
                ground=OUTER,
                gaussians=outer,
                elsewhere=(),
            )
        )

    def _bake(
        self,
        name: str,
        source: str = "teacher",
        *,
        ground: str = CLOTHED,
        student: StudentConfig | None = None,
        config: BakeConfig | None = None,
        cloth: str | None = "cloth",
        elsewhere: tuple[str, ...] = (),
    ) -> None:
        student = student or self.student
        # Loose clothes are simulated in the place of the field, and found on the surface that a teacher has tracked.
        simulates = ground == CLOTHED and source == "teacher" and student.field is not None
        self._add(
            BakeStage(
                name=_folder(name),
                ground=ground,
                source=self.stages[source],
                cloth=self.stages[cloth] if cloth is not None and simulates else None,
                student=student,
                config=config or self.preset.bake,
                elsewhere=elsewhere,
            )
        )

    def _compensate(
        self,
        name: str,
        baked: str,
        *,
        ground: str = CLOTHED,
        teacher: str | None = "teacher",
        shapes: BlendShapeConfig | None = None,
        null_share: float = 0.0,
        elsewhere: tuple[str, ...] = (),
    ) -> None:
        own, student = self.preset.compensate, self.stages[baked]
        assert isinstance(student, BakeStage)
        self._add(
            CompensateStage(
                name=_folder(name),
                ground=ground,
                student=student,
                cloth=student.cloth,
                teacher=self.stages[teacher] if teacher is not None and own.init_from_track else None,
                shapes=shapes or self.preset.blend_shapes,
                config=replace(own, null_share=max(own.null_share, null_share)),
                elsewhere=elsewhere,
            )
        )

    def _add(self, stage: ModelStage) -> None:
        self.stages[Path(stage.name).name] = stage


def _folder(name: str) -> str:
    """Return the folder of a stage of the ablation."""
    return f"{ABLATION}/{name}"


def _without_teacher(preset: TrainingPreset, training_frames: int) -> int:
    """Return the number of steps of the bake from photographs alone.

    Where the teacher's stage tracks the surface, rows with a teacher see photographs in three trainings; the bake
    without a teacher sees as many views as those three. Otherwise it has its own number of steps, as in the paper.
    """
    teacher, bake = preset.teacher, preset.bake
    if teacher.track is None:
        return bake.iterations
    seen = teacher.iterations * teacher.views + training_frames * teacher.track.steps * teacher.track.views
    seen += 0 if teacher.joint is None else teacher.joint.looks * teacher.joint.steps(training_frames)
    return bake.iterations + math.ceil(seen / bake.views)
