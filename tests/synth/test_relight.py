"""A person under a second light as truth: what relighting of the first picture comes to."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.core import Camera, InputError, TriangleMesh
from smplxpp.core.light import Irradiance, Relighting
from smplxpp.people.fixture_person import load_person
from smplxpp.raster.soft_light import Environment, LightConfig, environment_light, stage_light, vertex_light
from smplxpp.synth.views import LitFrame, hidden_faces, normal_map, render_view
from tests.core.test_light import evening
from tests.synth.test_synth import FIXTURE, TOPOLOGY, slab

LIGHT = LightConfig(directions=64, resolution=128)


def decibels(picture: np.ndarray, truth: np.ndarray, inside: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.square(picture - truth)[inside].mean()))


@pytest.fixture(scope="module")
def frames():
    """The person of the fixture in its first frame, in the stage's light and in the evening's, and the evening."""
    person = load_person(TOPOLOGY)
    with np.load(FIXTURE / "geometry" / "frame_000000.npz") as file:
        vertices = file["verts"].astype(np.float64)
    shown = np.flatnonzero(~hidden_faces(person, vertices))
    mesh = TriangleMesh(vertices, person.tpose.faces[shown])
    panorama = evening()
    panorama = panorama / Irradiance.of_environment(panorama).mean
    light = vertex_light(mesh, LIGHT)
    stage = LitFrame(mesh, shown, light)
    return person, stage, LitFrame(mesh, shown, light, environment_light(mesh, LIGHT, panorama)), panorama


@pytest.mark.parametrize("side", [0.0, 120.0])
def test_a_relit_picture_is_near_the_one_that_the_light_would_have_made(frames, side):
    person, stage, evening_frame, panorama = frames
    middle, angle = stage.mesh.vertices.mean(axis=0), np.radians(side)
    eye = middle + 3.2 * np.array([np.sin(angle), 0.1, np.cos(angle)])
    camera = Camera.look_at(eye=eye, target=middle, fov_y_deg=34.0, width=120, height=160)
    before, truth = (render_view(person, one, camera, supersampling=2) for one in (stage, evening_frame))
    inside = truth.mask == 255
    relighting = Relighting(Irradiance.of_environment(panorama), stage_light())
    relit = relighting.colors(before.image / 255.0, normal_map(stage, camera))
    plain, found = (decibels(one, truth.image / 255.0, inside) for one in (before.image / 255.0, relit))
    assert plain < 20.0 and found > 26.0 and found > plain + 8.0


@pytest.mark.long
def test_a_turned_environment_shines_from_elsewhere_as_brightly_as_the_stage(frames):
    _, stage, _, panorama = frames
    mesh, config = stage.mesh, LightConfig(directions=32, resolution=64)
    found = Environment(7.0 * panorama, turn=40.0).at(mesh, config)
    level = Environment(panorama, turn=40.0, exposure=2.0 * stage_light().mean).at(mesh, config)
    np.testing.assert_allclose(2.0 * found, level, rtol=1e-6)
    # Shadows aside, it is what the harmonics of the turned light say, and not those of another turn.
    likeness = {
        turn: np.corrcoef(Irradiance.of_environment(panorama, turn=turn).at(mesh.vertex_normals)[:, 0], found[0, :, 0])
        for turn in (40.0, 0.0, -40.0)
    }
    assert likeness[40.0][0, 1] > 0.7 and likeness[40.0][0, 1] > max(likeness[t][0, 1] for t in (0.0, -40.0)) + 0.03
    with pytest.raises(InputError, match="light"):
        Environment(0.0 * panorama)
    with pytest.raises(InputError, match="exposure"):
        Environment(panorama, exposure=0.0)


def test_an_open_plane_takes_what_the_harmonics_say():
    """Nothing hides the light of a plane: gathered along directions it is the irradiance."""
    plane = slab(0.0)
    inner = np.abs(plane.vertices[:, [0, 2]]).max(axis=1) < 0.4
    gathered = environment_light(plane, LIGHT, evening())[:, inner]
    light = Irradiance.of_environment(evening())
    for side, normal in enumerate(([0.0, 1.0, 0.0], [0.0, -1.0, 0.0])):
        np.testing.assert_allclose(gathered[side].mean(axis=0), light.at(np.array(normal)), rtol=0.15, atol=0.02)
    stage = stage_light().at(np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]))[:, 0]
    np.testing.assert_allclose(vertex_light(plane, LIGHT)[:, inner].mean(axis=1), stage, rtol=0.05)
