"""The folder of a run: the name of every stage and file, said once."""

from __future__ import annotations

CAPTURE_STAGE = "00_capture"
REGISTER_STAGE = "10_register"
SEGMENT_STAGE = "20_segment"
CLEAN_STAGE = "30_clean"
TRANSFER_STAGE = "40_transfer"
UNPOSE_STAGE = "50_unpose"
ASSEMBLE_STAGE = "60_assemble"
VALIDATE_STAGE = "65_validate"
BIND_STAGE = "70_bind"
TEACHER_STAGE = "80_teacher"
BAKE_STAGE = "85_bake"
COMPENSATE_STAGE = "90_compensate"
EVALUATE_STAGE = "95_evaluate"
ABLATION = "ablation"

BUILD_STAGES = (
    CAPTURE_STAGE,
    REGISTER_STAGE,
    SEGMENT_STAGE,
    CLEAN_STAGE,
    TRANSFER_STAGE,
    UNPOSE_STAGE,
    ASSEMBLE_STAGE,
    VALIDATE_STAGE,
)
"""The stages of `smplxpp build`."""
TRAIN_STAGES = (TEACHER_STAGE, BAKE_STAGE, COMPENSATE_STAGE)
"""The stages that `smplxpp train` adds to a reference fit."""
MODEL_STAGES = (BIND_STAGE, *TRAIN_STAGES)
ALL_STAGES = (*BUILD_STAGES, *MODEL_STAGES, EVALUATE_STAGE)

SCAN = f"{CAPTURE_STAGE}/scan.npz"
PARAMS = f"{CAPTURE_STAGE}/params.npz"
POSED_BODY = f"{REGISTER_STAGE}/body.npz"
SCAN_LABELS = f"{SEGMENT_STAGE}/labels.npz"
PARTS = f"{CLEAN_STAGE}/parts.npz"
WEIGHTS = f"{TRANSFER_STAGE}/weights.npz"
PARTS_WITHOUT_WEBS = f"{TRANSFER_STAGE}/parts.npz"
CANONICAL = f"{UNPOSE_STAGE}/canonical.npz"
TEMPLATE = f"{ASSEMBLE_STAGE}/smplxpp.npz"
TEMPLATE_GLB = f"{ASSEMBLE_STAGE}/template.glb"
TEMPLATE_OBJ = f"{ASSEMBLE_STAGE}/template.obj"
TEMPLATE_ERRORS = f"{VALIDATE_STAGE}/errors.npz"
GAUSSIANS = f"{BIND_STAGE}/gaussians.safetensors"
SPLATS = f"{BIND_STAGE}/splats.ply"
TEACHER = f"{TEACHER_STAGE}/teacher.safetensors"
BAKED = f"{BAKE_STAGE}/student.safetensors"
STUDENT = f"{COMPENSATE_STAGE}/student.safetensors"
COMPACT_STUDENT = f"{COMPENSATE_STAGE}/student_compact.safetensors"
REGISTERED_PARAMS = "05_register/params.npz"
REFINED_PARAMS = "66_refine/params.npz"
REFINED_HELD_OUT_PARAMS = "66_refine/params_held_out.npz"
EVALUATION = f"{EVALUATE_STAGE}/metrics.json"

BUILD_FILE = "build.json"
"""What a run was built from, so that later stages can write its report anew."""
METRICS_FILE = "metrics.json"
REPORT_FILE = "report.html"
