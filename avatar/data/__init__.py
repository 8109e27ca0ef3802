"""A capture as training sees it: views, poses, and what is kept in memory."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "AvatarSequence": "avatar.data.sequence",
    "ClothMotionConfig": "avatar.data.cloth_motion",
    "ClothMotions": "avatar.data.cloth_motion",
    "OneFrame": "avatar.data.one_frame",
    "SequenceConfig": "avatar.data.sequence",
    "View": "avatar.data.views",
    "read_view": "avatar.data.views",
    "read_views": "avatar.data.views",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.data", _EXPORTS)
