"""Loose clothes in the viewer of a run: they follow what is shown, as the player's steps do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.model_file import save_avatar
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from pipelines.runs.layout import GARMENTS, STUDENT, TEMPLATE
from pipelines.viewer.run_models import open_player
from pipelines.viewer.run_session import RunSession, open_run
from pipelines.viewer.run_window import open_run_window
from smplxpp.cloth import GarmentConfig, cut_garment
from smplxpp.cloth.garment_file import save_garments
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template
from tests.cloth.persons import PART, person, standing
from tests.cloth.test_driver import swaying
from tests.viewer.test_window import free_port

FPS = 20.0
EYE = np.array([0.0, 1.0, 3.0])


@pytest.fixture(scope="module")
def dressed(tmp_path_factory) -> tuple[Path, Template, Path]:
    """A run of the person of balls in a skirt, its template, and a motion."""
    run, template = tmp_path_factory.mktemp("dressed") / "run", person()
    for file in (TEMPLATE, GARMENTS, STUDENT):
        (run / file).parent.mkdir(parents=True)
    template.save(run / TEMPLATE)
    torch.manual_seed(1)
    config = StudentConfig(FieldConfig(width=8, hidden_layers=2, code_size=4), None, control_points=40)
    bound = sample_on_mesh(template, SamplingConfig(count=300))
    save_avatar(run / STUDENT, Student(config, Rig(template), bound, (0, 1)))
    cut = GarmentConfig(spacing=0.06, collider_spacing=0.04)
    save_garments(run / GARMENTS, [cut_garment(template, PART, standing(), cut)])
    motion = replace(BodyParams.concatenate([swaying(k / FPS) for k in range(12)]), fps=FPS)
    motion.save(run.parent / "motion.npz")
    return run, template, run.parent / "motion.npz"


def shown(session: RunSession) -> np.ndarray:
    splats = session.splats(EYE)
    assert splats is not None
    return splats.means


@pytest.mark.long
def test_clothes_follow_the_frames_and_begin_anew_after_a_jump_back(dressed):
    run, template, motion = dressed
    session = open_run(run, template, params=motion)
    assert session.dressed and session.simulated and session.source is not None
    player = open_player(run, template, session.source)
    expected = []
    for row in (0, 1, 2, 5):
        session.go_to(row)
        step = 1 if row < 3 else 3
        expected.append(player.step(session.params, step / FPS).means.copy())
        np.testing.assert_allclose(shown(session), expected[-1], atol=1e-6)
        np.testing.assert_array_equal(shown(session), shown(session))  # a redraw is no step
    skinned = player.pose(session.params).means.copy()
    assert np.abs(expected[-1] - skinned).max() > 1e-3
    session.go_to(0)
    np.testing.assert_allclose(shown(session), expected[0], atol=1e-6)
    session.simulated = False
    session.go_to(5)
    np.testing.assert_allclose(shown(session), skinned, atol=1e-6)


def test_the_window_switches_them(dressed):
    run, template, motion = dressed
    session = open_run(run, template, params=motion)
    window = open_run_window(session, port=free_port())
    try:
        assert window._cloth.visible and window._cloth.value
        window._cloth.value = False
        window._simulate()
        assert not session.simulated
    finally:
        window.close()
