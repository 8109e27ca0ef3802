"""What the ablation's rows are, and the pieces that they are made from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

from avatar.baselines.photograph_task import PhotographConfig
from avatar.baselines.point_mlp import PointMLPConfig
from avatar.baselines.textured_mesh import TexturedMeshConfig
from avatar.baselines.uv_unet import UVUNetConfig
from avatar.models.student import StudentConfig
from avatar.training.presets import LOCAL, TrainingPreset
from pipelines.ablation.pieces import (
    CLOTHED,
    NAKED,
    OUTER,
    BakePiece,
    BaselinePiece,
    CompensatePiece,
    FitPiece,
    Piece,
    PrunedPiece,
    SamePiece,
    TeacherPiece,
)
from smplxpp.core.errors import InputError

PRUNED_SHARE, PRUNED_MEGABYTES = 0.3, 20.0
CONTROL_POINTS = 400
NULL_SHARE = 0.2


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        title: as tables have it. piece: that is measured. note: what is different, in words.
        null_code: the avatar is driven by the null code in every frame.
    """

    title: str
    piece: str
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
    "local": Row(
        "local blend shapes", "local", f"{LOCAL['parts']} parts of the Gaussians with coefficients of their own"
    ),
    "pruned": Row(
        "pruned",
        "pruned",
        f"Full; {PRUNED_SHARE:.0%} of the Gaussians keep blend shapes, in {PRUNED_MEGABYTES:g} MB",
    ),
    "control": Row("control points", "control", f"the field on {CONTROL_POINTS} vertices, interpolated to the rest"),
    "gated": Row("gated", "gated", "head shapes act on the head alone, body shapes on the rest"),
    "null-code": Row("null code", "null_code", "driven by the null code in every frame, as online", null_code=True),
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
    """Rows by their names and those of groups ("paper", "options", "all"), in the table's order.

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


def ablation_pieces(
    preset: TrainingPreset, *, frame: int, training_frames: int, built_frame: int | None = None
) -> dict[str, Piece]:
    """Every piece that rows may need, by name; a preset decides all sizes and iterations.

    Args:
        frame: that Gaussians are fitted to. training_frames: number of them.
        built_frame: the training frame whose surface the template is, if any.
    """
    pieces: dict[str, Piece] = {}
    student = preset.student()

    def bake(name: str, *, student: StudentConfig = student, source: str = "teacher", **changes: float) -> None:
        pieces[name] = BakePiece(source=source, student=student, config=replace(preset.bake, **changes))

    def compensate(
        name: str, baked: str, *, ground: str = CLOTHED, teacher: str = "teacher", null: float = 0.0, **shapes: int
    ) -> None:
        pieces[name] = CompensatePiece(
            ground=ground,
            student=baked,
            teacher=teacher if preset.compensate.init_from_track else "",
            shapes=replace(preset.blend_shapes, **shapes),
            config=replace(preset.compensate, null_share=max(preset.compensate.null_share, null)),
        )

    teacher = preset.teacher
    if teacher.track is not None:
        teacher = replace(teacher, track=replace(teacher.track, reference=built_frame, seed=teacher.seed))
    for ground, prefix in ((CLOTHED, ""), (NAKED, "naked_")):
        fit = f"{prefix}gaussians"
        pieces[fit] = FitPiece(ground=ground, config=replace(preset.fit, evaluations=1), frame=frame)
        pieces[f"{prefix}teacher"] = TeacherPiece(
            ground=ground, gaussians=fit, networks=preset.networks.teacher, config=teacher
        )
        pieces[f"{prefix}bake"] = BakePiece(
            ground=ground, source=f"{prefix}teacher", student=student, config=preset.bake
        )
    compensate("full", "bake")
    compensate("naked", "naked_bake", ground=NAKED, teacher="naked_teacher")
    bake("no_field_bake", student=replace(student, field=None, control_points=0))
    compensate("no_field", "no_field_bake")
    bake("no_teacher_bake", source="gaussians", iterations=_without_teacher(preset, training_frames))
    compensate("no_teacher", "no_teacher_bake", teacher="")

    if teacher.track is None:
        pieces["untracked"] = SamePiece(student="full")
    else:
        from_zero = replace(teacher, track=None, pretrain=None)
        pieces["untracked_teacher"] = replace(pieces["teacher"], config=from_zero)
        bake("untracked_bake", source="untracked_teacher")
        compensate("untracked", "untracked_bake", teacher="")
    compensate("local", "bake", **LOCAL)
    compensate("gated", "bake", gated=True)
    pieces["pruned"] = PrunedPiece(student="full", keep=PRUNED_SHARE, max_bytes=1e6 * PRUNED_MEGABYTES)
    bake("control_bake", student=replace(student, control_points=CONTROL_POINTS))
    compensate("control", "control_bake")
    if preset.bake.null_share and preset.compensate.null_share:
        pieces["null_code"] = SamePiece(student="full")
    else:
        bake("null_code_bake", null_share=max(preset.bake.null_share, NULL_SHARE))
        compensate("null_code", "null_code_bake", null=NULL_SHARE)
    return pieces | _baseline_pieces(preset, pieces)


def _without_teacher(preset: TrainingPreset, training_frames: int) -> int:
    """Steps of the bake from photographs alone.

    Where the teacher's stage follows the surface, and rows with a teacher so compare with photographs in three
    trainings, as many views as those three together; otherwise the bake's own, as in the paper.
    """
    teacher, bake = preset.teacher, preset.bake
    if teacher.track is None:
        return bake.iterations
    seen = teacher.iterations * teacher.views + training_frames * teacher.track.steps * teacher.track.views
    return bake.iterations + math.ceil(seen / bake.views)


def _baseline_pieces(preset: TrainingPreset, pieces: Mapping[str, Piece]) -> dict[str, Piece]:
    """Avatars of other kinds: as many steps on photographs as the student's bake and compensation have together."""
    steps = preset.bake.iterations + preset.compensate.iterations
    own = {f.name: getattr(preset.bake, f.name) for f in fields(PhotographConfig)}
    photographs = replace(PhotographConfig(**own), iterations=steps)
    still = StudentConfig(field=None)
    skinned = replace(preset.bake, iterations=steps)
    # As fine as half the teacher's maps: charts of an atlas waste less of them than two views of a body.
    unet = UVUNetConfig(size=preset.networks.teacher.out_size // 2)
    mesh = TexturedMeshConfig(preset.networks.field, preset.fit.sampling)
    return {
        "lbs": BakePiece(source="gaussians", student=still, config=skinned),
        "lbs_naked": BakePiece(ground=NAKED, source="naked_gaussians", student=still, config=skinned),
        "mlp": BaselinePiece(gaussians="gaussians", model=PointMLPConfig(), config=photographs),
        "uv": BaselinePiece(ground=NAKED, gaussians="naked_gaussians", model=unet, config=photographs),
        "mesh": BaselinePiece(gaussians="gaussians", model=mesh, config=replace(photographs, attributes=0.0)),
        "outer_gaussians": replace(pieces["gaussians"], ground=OUTER),
        "outer_teacher": replace(pieces["teacher"], ground=OUTER, gaussians="outer_gaussians"),
    }
