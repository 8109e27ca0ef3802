"""The avatar trained on an SMPLX++ template: Gaussians on its triangles, a teacher, a student, what measures them.

The names below are loaded when they are first used, so that importing the package is quick.
"""

from __future__ import annotations

from smplxpp.core.lazy import lazy_exports
from smplxpp.native import let_workers_sleep

let_workers_sleep()
_EXPORTS: dict[str, str] = {
    "AvatarSequence": "avatar.data.sequence",
    "BoundGaussians": "avatar.gaussians",
    "EvaluationConfig": "avatar.evaluation.evaluate",
    "FitConfig": "avatar.training.fit.fit",
    "FitScene": "avatar.training.fit.fit",
    "ProtocolConfig": "avatar.evaluation.protocol",
    "Rig": "avatar.rig.rig",
    "SamplingConfig": "avatar.gaussians",
    "Session": "avatar.training.engine.session",
    "Student": "avatar.models.student",
    "TrainConfig": "avatar.training.recipe",
    "TeacherAvatar": "avatar.models.teacher_avatar",
    "bake": "avatar.training.student.bake",
    "bundle_file": "avatar.export.open_bundle",
    "compensate": "avatar.training.student.compensate",
    "export_student": "avatar.export.student_export",
    "evaluate_models": "avatar.evaluation.evaluate",
    "fit_gaussians": "avatar.training.fit.fit",
    "fit_teacher": "avatar.training.fit_teacher",
    "load": "avatar.models.open_student",
    "load_avatar": "avatar.models.model_file",
    "mean_quality": "avatar.metrics.view_quality",
    "open_bundle": "avatar.export.open_bundle",
    "rasterize": "avatar.rendering",
    "read_views": "avatar.data.views",
    "render": "avatar.rendering.avatar_view",
    "render_view": "avatar.rendering.avatar_view",
    "sample_on_mesh": "avatar.gaussians",
    "save_avatar": "avatar.models.model_file",
    "train": "avatar.training.train",
    "training_preset": "avatar.training.presets",
    "write_splat_ply": "avatar.formats",
}

__all__ = [*_EXPORTS]

# `avatar.runtime` plays without torch: its player takes `BundleOnDevice` from here, where a GPU is asked for.
_MORE = {"__version__": "smplxpp", "BundleOnDevice": "avatar.rendering.on_device"}
__getattr__, __dir__ = lazy_exports("avatar", {**_EXPORTS, **_MORE})
