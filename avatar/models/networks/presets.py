"""Presets of network sizes, by the name of the training preset."""

from __future__ import annotations

from dataclasses import dataclass, replace

from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.networks.teacher import TeacherConfig
from smplxpp.core.errors import require_choice


@dataclass(frozen=True)
class NetworkPreset:
    """Sizes of the teacher and of the field in a preset."""

    teacher: TeacherConfig
    field: FieldConfig


_LEAN = TeacherConfig(networks="shared", position_size=128, centred=True, style_layers=1, noise=False, zero_output=True)

# Three networks, as published.
_SMALL = TeacherConfig(centred=True, style_layers=1, noise=False, zero_output=True)

_TEACHERS = {
    "paper": TeacherConfig(),
    "gpu": replace(_LEAN, in_size=256, out_size=512, channel_base=8192, channel_max=128, style_size=64),
    "paper-small": replace(_SMALL, in_size=128, out_size=256, channel_base=2048, channel_max=64, style_size=32),
    "cpu": replace(_LEAN, in_size=128, out_size=256, channel_base=2048, channel_max=64, style_size=32),
    "demo": replace(_LEAN, in_size=64, out_size=128, channel_base=1024, channel_max=32, style_size=16),
}

# Captures have few poses for 63 numbers: a vertex depends on nearby joints alone.
_FIELDS = {name: FieldConfig(local_pose=3) for name in ("gpu", "cpu", "demo")}

NETWORK_PRESETS = {
    # The field has the paper's sizes in all presets, because it is small.
    name: NetworkPreset(teacher, _FIELDS.get(name, FieldConfig()))
    for name, teacher in _TEACHERS.items()
}


def network_preset(name: str) -> NetworkPreset:
    """Return the preset "paper", "gpu", "paper-small", "cpu" or "demo".

    Raises:
        InputError: another name.
    """
    require_choice("preset", name, tuple(NETWORK_PRESETS))
    return NETWORK_PRESETS[name]
