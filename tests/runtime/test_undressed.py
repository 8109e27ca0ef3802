"""Skin lies bare while a player takes off the clothes that hide it, and with all clothes on nothing changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion

from avatar.export.bundle import BundleExtras, write_bundle
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from avatar.runtime import AvatarPlayer, load_bundle
from avatar.runtime.bundle import undressed
from avatar.runtime.layout import BARE
from smplxpp.core import Camera, InputError, TriangleMesh
from smplxpp.raster import rasterize_mesh
from tests.cloth.persons import HEM, WAIST, person, standing
from tests.cloth.test_driver import swaying

SKIN, SMEAR = (0.8, 0.6, 0.5), (0.1, 0.2, 0.9)


def smeared(path: Path) -> Path:
    """Write the person in a skirt whose hidden skin fills gaps of it, as trainings leave it: centimetres off, blue."""
    it = Student(StudentConfig(None, None), Rig(person()), sample_on_mesh(person(), SamplingConfig(count=1500)), ())
    own, template = it.gaussians, it.rig.template
    height = template.mesh.face_centers[own.face_index.numpy(), 1]
    skin = template.vertex_part[template.faces[own.face_index.numpy(), 0]] == 0
    rows = torch.tensor(np.flatnonzero(skin & (height > HEM) & (height < WAIST)))
    with torch.no_grad():
        own.dc[:] = torch.tensor(SKIN)
        own.dc[rows] = torch.tensor(SMEAR)
        own.offset[rows, 0] += 0.05
        own.log_scales[rows] += 1.0
        own.opacity_logits[rows] = 0.0
    write_bundle(path, it, BundleExtras(name="smeared"))
    return path


@pytest.fixture(scope="module")
def smear(tmp_path_factory) -> Path:
    return smeared(tmp_path_factory.mktemp("smear") / "me.avatar")


def test_hidden_skin_lies_on_the_skin_in_its_colour_while_its_clothes_are_off(smear):
    player = AvatarPlayer(smear, threads=1)
    t, names = player.bundle.tensors, player.bundle.about.part_names
    covered = t["gaussians.covered"] == 1
    assert covered.sum() > 100
    part = t["surface.parts"][t["surface.faces"][:, 0]]
    template = person()
    skin = template.faces[template.vertex_part[template.faces[:, 0]] == 0]
    # Metres: on the skin at rest; in a pose hips and thighs of this person, which are rigid, move past each other.
    for params, near in ((standing(), 0.0005), (swaying(0.4), 0.01)):
        worn = player.pose(params)
        before = [np.array(x) for x in (worn.means, worn.quats, worn.scales, worn.opacities, worn.dc, worn.sh)]
        player.hide([names[1]])
        bare = player.pose(params)
        squared, _, _ = igl.point_mesh_squared_distance(
            bare.means[covered].astype(float), template.pose(params)[0], skin
        )
        assert np.sqrt(squared).max() < near
        assert np.abs(before[0][covered] - bare.means[covered]).max() > 0.03
        assert (bare.opacities[covered] == 1.0).all() and np.abs(bare.dc[covered] - SKIN).max() < 0.01
        assert (bare.opacities[(part == 1)[worn.face]] == 0.0).all()
        shown = ~covered & (part == 0)[worn.face]
        np.testing.assert_array_equal(bare.means[shown], before[0][shown])
        # With clothes on again the same bits.
        player.hide([])
        again = player.pose(params)
        now = (again.means, again.quats, again.scales, again.opacities, again.dc, again.sh)
        assert all(np.array_equal(a, b) for a, b in zip(before, now, strict=True))


def test_bare_skin_has_no_holes_and_shows_nothing_of_the_smear(smear):
    player = AvatarPlayer(smear, threads=1)
    player.hide(["lower"])
    player.pose(standing())
    # A view from ahead, 1.2 m high, and the skin in it, without its outline of a pixel.
    K = np.array([[300.0, 0.0, 64.0], [0.0, 300.0, 64.0], [0.0, 0.0, 1.0]])
    view = np.diag([1.0, -1.0, -1.0, 1.0])
    view[:3, 3] = 0.0, 0.7, 3.0
    camera = Camera(K, view, 128, 128)
    template = person()
    mesh = TriangleMesh(template.pose(standing())[0], template.faces[template.vertex_part[template.faces[:, 0]] == 0])
    # Rows of pixels from the waist to the hem.
    below = (np.abs(0.7 - (np.arange(128)[:, None] - 64) / 100.0 - 0.5 * (WAIST + HEM)) < 0.45 * (WAIST - HEM)).repeat(
        128, 1
    )
    body = binary_erosion(below & np.isfinite(rasterize_mesh(mesh, camera).depth))
    assert body.sum() > 500
    picture, alpha = player.draw(camera)
    assert alpha[body].min() > 0.9
    assert np.abs(picture / np.maximum(alpha, 1e-3)[..., None] - SKIN)[body].max() < 0.05


def test_bundles_that_say_no_bare_skin_lose_the_part_alone(smear):
    bundle = load_bundle(smear)
    older = replace(bundle, tensors={k: v for k, v in bundle.tensors.items() if k.split(".")[-1] not in BARE})
    off = undressed(older, [1])
    assert undressed(older, []) is older
    for name, value in off.tensors.items():
        assert name == "gaussians.opacities" or value is older.tensors[name]
    assert (off.tensors["gaussians.opacities"] == 0.0).any()


def test_a_part_that_the_avatar_has_not_is_named(smear):
    with pytest.raises(InputError, match=r"part to hide.*body"):
        AvatarPlayer(smear, threads=1).hide(["cape"])
