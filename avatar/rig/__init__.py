"""The rig: a template that torch poses and skins, and the posed avatar."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "AvatarModel": "avatar.rig.rig",
    "Pose": "avatar.rig.rig",
    "PosedAvatar": "avatar.rig.rig",
    "Rig": "avatar.rig.rig",
    "SimulatedCloth": "avatar.rig.rig",
    "at_rest": "avatar.rig.rig",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.rig", _EXPORTS)
