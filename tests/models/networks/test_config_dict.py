"""Configurations of networks through JSON and back, and what is refused."""

from __future__ import annotations

import json

import pytest

from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.config_dict import config_from_dict, config_to_dict
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.networks.teacher import NETWORK_PRESETS, TeacherConfig
from smplxpp.core.errors import InputError


@pytest.mark.parametrize("name", list(NETWORK_PRESETS))
def test_presets_survive_json(name):
    preset = NETWORK_PRESETS[name]
    for config in (preset.teacher, preset.field, BlendShapeConfig()):
        assert config_from_dict(type(config), json.loads(json.dumps(config_to_dict(config)))) == config


def test_whole_number_stands_for_a_float():
    stored = config_to_dict(TeacherConfig()) | {"position_scale": 1}
    restored = config_from_dict(TeacherConfig, stored)
    assert restored.position_scale == 1.0 and isinstance(restored.position_scale, float)


@pytest.mark.parametrize(
    "changes", [{"unknown": 1}, {"width": "64"}, {"width": 64.0}, {"width": True}, {"width": 0}, {"width": None}]
)
def test_refused_fields(changes):
    with pytest.raises(InputError):
        config_from_dict(FieldConfig, config_to_dict(FieldConfig()) | changes)


def test_missing_field_is_refused():
    stored = config_to_dict(BlendShapeConfig())
    del stored["parts"]
    with pytest.raises(InputError, match="another version"):
        config_from_dict(BlendShapeConfig, stored)
