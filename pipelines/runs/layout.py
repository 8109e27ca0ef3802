"""Names of the stages and files of a run folder.

The numbers of the stages give the order in which they run.
"""

from __future__ import annotations

from collections.abc import Mapping

RECONSTRUCT_STAGE = "02_reconstruct"
LOCATE_STAGE = "03_locate"
REGISTER_STAGE = "05_register"
CAPTURE_STAGE = "08_capture"
POSE_BODY_STAGE = "10_body"
SEGMENT_STAGE = "20_segment"
CLEAN_STAGE = "30_clean"
TRANSFER_STAGE = "40_transfer"
UNPOSE_STAGE = "50_unpose"
ASSEMBLE_STAGE = "60_assemble"
VALIDATE_STAGE = "65_validate"
REFINE_STAGE = "66_refine"
FIT_STAGE = "70_fit"
TEACHER_STAGE = "80_teacher"
CLOTH_STAGE = "83_cloth"
BAKE_STAGE = "85_bake"
COMPENSATE_STAGE = "90_compensate"
EVALUATE_STAGE = "95_evaluate"
RELIGHT_STAGE = "97_relight"
OLD_STAGE_NAMES = {"00_capture": CAPTURE_STAGE, "70_bind": FIT_STAGE}
"""Stages by the names that earlier versions gave them; `pipelines.runs.folders.refuse_old_run` refuses such runs."""
ABLATION = "ablation"
TALKING_FILM = "talking.mp4"

TEMPLATE_STAGES = (
    CAPTURE_STAGE,
    POSE_BODY_STAGE,
    SEGMENT_STAGE,
    CLEAN_STAGE,
    TRANSFER_STAGE,
    UNPOSE_STAGE,
    ASSEMBLE_STAGE,
    VALIDATE_STAGE,
)
"""The stages of every build."""
BUILD_STAGES = (RECONSTRUCT_STAGE, LOCATE_STAGE, REGISTER_STAGE, *TEMPLATE_STAGES)
"""The stages of `smplxpp build` in their order. Parameters that are not given come from a registration, or from the
body found in a scan that comes alone, which a registration may start from."""
TRAIN_STAGES = (TEACHER_STAGE, CLOTH_STAGE, BAKE_STAGE, COMPENSATE_STAGE)
"""The stages that `smplxpp train` adds to a fit."""
MODEL_STAGES = (FIT_STAGE, *TRAIN_STAGES)
ALL_STAGES = (*BUILD_STAGES, REFINE_STAGE, *MODEL_STAGES, EVALUATE_STAGE, RELIGHT_STAGE)

RECONSTRUCTION = f"{RECONSTRUCT_STAGE}/reconstruction.json"
LOCATED_PARAMS = f"{LOCATE_STAGE}/params.npz"
LOCATION_FILE = "location.json"
NOT_FOUND_PICTURE = "body_not_found.png"
"""The scan with the body that was found in it, in a run whose build stopped there."""
REGISTERED_PARAMS = f"{REGISTER_STAGE}/params.npz"
REGISTRATION = f"{REGISTER_STAGE}/registration.json"
SCAN = f"{CAPTURE_STAGE}/scan.npz"
PARAMS = f"{CAPTURE_STAGE}/params.npz"
POSED_BODY = f"{POSE_BODY_STAGE}/body.npz"
SCAN_LABELS = f"{SEGMENT_STAGE}/labels.npz"
LABEL_TABLE = f"{SEGMENT_STAGE}/label_table.json"  # where labels are not the built-in ones alone
PARTS = f"{CLEAN_STAGE}/parts.npz"
WEIGHTS = f"{TRANSFER_STAGE}/weights.npz"
PARTS_WITHOUT_BRIDGES = f"{TRANSFER_STAGE}/parts.npz"
CANONICAL = f"{UNPOSE_STAGE}/canonical.npz"
TEMPLATE = f"{ASSEMBLE_STAGE}/smplxpp.npz"
TEMPLATE_GLB = f"{ASSEMBLE_STAGE}/template.glb"
GAUSSIANS = f"{FIT_STAGE}/gaussians.safetensors"
SPLATS = f"{FIT_STAGE}/splats.ply"
TEACHER = f"{TEACHER_STAGE}/teacher.safetensors"
GARMENTS = f"{CLOTH_STAGE}/garments.npz"
BAKED = f"{BAKE_STAGE}/student.safetensors"
STUDENT = f"{COMPENSATE_STAGE}/student.safetensors"
COMPACT_STUDENT = f"{COMPENSATE_STAGE}/student_compact.safetensors"
REFINED_PARAMS = f"{REFINE_STAGE}/params.npz"
REFINED_HELD_OUT_PARAMS = f"{REFINE_STAGE}/params_held_out.npz"
REFINED_CAMERAS = f"{REFINE_STAGE}/cameras.json"
EVALUATION = f"{EVALUATE_STAGE}/metrics.json"

BUILD_FILE = "build.json"
"""What a run was built from, so that later stages can rewrite its report."""
REGISTER_FILE = "register.json"
"""What a run's registration was made from."""
LANDMARKS_FILE = "landmarks.json"
"""Landmarks that were placed by hand on the run's scan; no stage writes or removes it."""
CORRECTIONS_FILE = "labels_corrections.json"
"""Labels that were corrected by hand on the run's scan; no stage writes or removes it."""
RECONSTRUCT_FILE = "reconstruct.json"
"""What a run's surfaces were reconstructed from."""
METRICS_FILE = "metrics.json"
REPORT_FILE = "report.html"


def reconstructed_scan(frame: int) -> str:
    """The file of a frame's reconstructed surface: what a build takes as its scan."""
    return f"{RECONSTRUCT_STAGE}/scan_{frame:06d}.ply"


MODEL_FILES: Mapping[str, str] = {
    "fit": GAUSSIANS,
    "teacher": TEACHER,
    "baked": BAKED,
    "student": STUDENT,
    "compact": COMPACT_STUDENT,
}
"""Models of a run by the name that an evaluation gives them. `baked` is the student before its blend shapes."""
MEASURED = ("fit", "teacher", "student")
"""Models that are measured by default, as far as a run has them."""
BEST_FIRST = ("student", "compact", "baked", "teacher")
"""Preference for the model that the gates apply to: the first of these that was measured."""
HELD_OUT_VIEWS = ("novel_view", "novel_pose")
KINDS = {"novel_view": "novel views", "novel_pose": "novel poses"}
"""Titles of the kinds of views that a training measures."""


def kind_name(kind: str, *, held_out: bool) -> str:
    """Return the words for a kind of views; without held-out cameras "novel" views are views that were trained on."""
    return KINDS[kind] if held_out or kind != "novel_view" else "training views"
