"""The networks of the teacher and the student: modules alone, without losses or training."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "Student": "avatar.models.student",
    "StudentConfig": "avatar.models.student",
    "StudentFiles": "avatar.models.open_student",
    "StudentOrigin": "avatar.models.student",
    "TeacherAvatar": "avatar.models.teacher_avatar",
    "Track": "avatar.models.tracked_surface",
    "load": "avatar.models.open_student",
    "load_avatar": "avatar.models.model_file",
    "save_avatar": "avatar.models.model_file",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.models", _EXPORTS)
