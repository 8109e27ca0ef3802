"""Names that the stage of an evaluation and the report's section on it share."""

from __future__ import annotations

from collections.abc import Mapping

from pipelines.build_config import FIT_STAGE

EVALUATE_STAGE = "95_evaluate"
REPORT_FILE = "metrics.json"
REFERENCE_FIT, TEACHER, BAKED, STUDENT = "reference-fit", "teacher", "baked", "student"
MODEL_FILES: Mapping[str, str] = {
    REFERENCE_FIT: f"{FIT_STAGE}/gaussians.safetensors",
    TEACHER: "80_teacher/teacher.safetensors",
    BAKED: "85_bake/student.safetensors",
    STUDENT: "90_compensate/student.safetensors",
}
"""Models of a run by the name that an evaluation gives them. `baked` is the student before its blend shapes."""
MEASURED = (REFERENCE_FIT, TEACHER, STUDENT)
"""Those that are measured where nothing else is asked for, as far as a run has them."""
BEST_FIRST = (STUDENT, BAKED, TEACHER)
"""What an evaluation is about: the first of these that was measured."""
HELD_OUT_VIEWS = ("novel_view", "novel_pose")
SURFACE_LIMIT_MM = 40.0
"""Distance that the colours of posed meshes end at."""
