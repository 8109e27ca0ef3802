"""Names that the stage of an evaluation and the report's section on it share."""

from __future__ import annotations

from collections.abc import Mapping

from pipelines.runs.layout import BAKED, COMPACT_STUDENT, GAUSSIANS, STUDENT, TEACHER

REPORT_FILE = "metrics.json"
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
