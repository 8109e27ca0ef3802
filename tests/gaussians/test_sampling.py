"""Gaussians placed on a template."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from avatar.gaussians.binding import THICKNESS, topology_digest, world_from_local
from avatar.gaussians.sampling import SamplingConfig, head_faces, sample_on_mesh, seen_faces
from smplxpp.core import InputError, TriangleMesh
from smplxpp.template.template import Template
from tests.export.templates import open_body_template, random_template


@pytest.fixture(scope="module")
def template() -> Template:
    return open_body_template()


def spread(**changes) -> SamplingConfig:
    """All faces alike, but for the changes."""
    return replace(SamplingConfig(count=6000, head_share=None, hidden_density=1.0), **changes)


def test_counts_are_met_exactly(template):
    config = SamplingConfig(count=5001, head_share=0.3)
    bound = sample_on_mesh(template, config)
    assert len(bound) == 5001 and bound.sh.shape == (5001, 3, 3)
    assert head_faces(template)[bound.face_index].sum() == round(0.3 * 5001)
    assert (bound.face_index.diff() >= 0).all()
    bound.check_topology(template.faces)
    assert bound.topology == topology_digest(template.faces)


@pytest.mark.parametrize(("share", "on_head"), [(0.0, 0), (1.0, 700)])
def test_all_or_nothing_on_the_head(template, share, on_head):
    bound = sample_on_mesh(template, SamplingConfig(count=700, head_share=share))
    assert head_faces(template)[bound.face_index].sum() == on_head


def test_the_seed_decides(template):
    one, again, other = (sample_on_mesh(template, spread(count=500, seed=s)) for s in (1, 1, 2))
    assert all(torch.equal(a, b) for a, b in zip(one.tensors.values(), again.tensors.values(), strict=True))
    assert not torch.equal(one.barycentric, other.barycentric)


def test_samples_follow_area(template):
    bound = sample_on_mesh(template, spread(count=60_000))
    share = template.mesh.face_areas / template.mesh.face_areas.sum()
    counts = np.bincount(bound.face_index, minlength=len(share))
    # Stratified: no run of faces is off by more than the two strata at its ends.
    assert np.abs(np.cumsum(counts) - 60_000 * np.cumsum(share)).max() <= 1.0


def test_density_moves_samples_within_a_region(template):
    density = np.where(template.mesh.triangles.mean(1)[:, 0] > 0.0, 3.0, 1.0)
    bound = sample_on_mesh(template, spread(count=60_000), density=density)
    share = density * template.mesh.face_areas / (density * template.mesh.face_areas).sum()
    counts = np.bincount(bound.face_index, minlength=len(share))
    assert np.abs(np.cumsum(counts) - 60_000 * np.cumsum(share)).max() <= 1.0
    one, other = (bound.log_scales[density[bound.face_index] == d, 0].mean() for d in (3.0, 1.0))
    assert float(other - one) > 0.4  # about log sqrt(3): fewer are larger, so that they meet
    headed = sample_on_mesh(template, SamplingConfig(count=5001, head_share=0.3), density=density)
    assert head_faces(template)[headed.face_index].sum() == round(0.3 * 5001)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_densities_have_to_be_one_positive_number_a_face(template, value):
    density = np.ones(len(template.faces))
    with pytest.raises(InputError, match="density"):
        sample_on_mesh(template, spread(count=100), density=density[:-1])
    density[3] = value
    with pytest.raises(InputError, match="density"):
        sample_on_mesh(template, spread(count=100), density=density)


def test_every_face_with_a_stratum_of_area_has_a_sample(template):
    bound = sample_on_mesh(template, spread())
    areas = template.mesh.face_areas
    large = areas > 2.0 * areas.sum() / 6000
    assert large.any() and np.isin(np.flatnonzero(large), bound.face_index).all()


def test_equally_many_in_every_face(template):
    count = 4 * len(template.faces)
    bound = sample_on_mesh(template, spread(count=count, spread_by="face"))
    assert (np.bincount(bound.face_index, minlength=len(template.faces)) == 4).all()


def test_points_are_uniform_inside_faces(template):
    bound = sample_on_mesh(template, spread(count=60_000))
    u, v = bound.barycentric.double().T
    w = 1 - u - v
    assert min(u.min(), v.min(), w.min()) > -1e-6
    for x in (u, v, w):  # of a uniform distribution on the triangle: mean 1/3, variance 1/18
        assert abs(float(x.mean()) - 1 / 3) < 5e-3 and abs(float(x.var()) - 1 / 18) < 2e-3


def test_neighbours_keep_apart_better_than_chance(template):
    bound = sample_on_mesh(template, spread(count=20_000))
    vertices = torch.tensor(template.vertices, dtype=torch.float32)
    points = world_from_local(bound, vertices, torch.tensor(template.faces)).means.numpy()
    distance = cKDTree(points).query(points, k=2)[0][:, 1]
    spacing = np.sqrt(template.mesh.face_areas.sum() / len(points))
    # Independent samples: 11 % of neighbours within a fifth of the spacing.
    assert (distance < 0.2 * spacing).mean() < 0.03


def test_hidden_faces_are_thin_or_bare(template):
    seen = seen_faces(template.mesh)
    assert 0.1 < (~seen).mean() < 0.5
    bare, thin = (
        sample_on_mesh(template, spread(count=20_000, hidden_density=d)).face_index.numpy() for d in (0.0, 0.25)
    )
    assert seen[bare].all()
    areas = template.mesh.face_areas
    density = [(~seen)[thin].sum() / areas[~seen].sum(), seen[thin].sum() / areas[seen].sum()]
    assert density[0] / density[1] == pytest.approx(0.25, rel=0.1)


def test_seen_faces_of_a_box_in_a_box():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    box = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    mesh = TriangleMesh(np.concatenate([corners, 0.5 * corners]), np.concatenate([box, box + 8]))
    np.testing.assert_array_equal(seen_faces(mesh), np.arange(24) < 12)


def test_first_values(template):
    bound = sample_on_mesh(template, spread(count=60_000, touch=0.8, opacity=0.7, sh_degree=2))
    vertices = torch.tensor(template.vertices, dtype=torch.float32)
    world = world_from_local(bound, vertices, torch.tensor(template.faces))
    spacing = np.sqrt(template.mesh.face_areas.sum() / 60_000)
    torch.testing.assert_close(world.scales[:, 1:], torch.full((60_000, 2), float(0.8 * spacing)), rtol=1e-4, atol=0)
    torch.testing.assert_close(world.opacities, torch.full((60_000,), 0.7))
    normals = torch.tensor(template.mesh.face_normals, dtype=torch.float32)[bound.face_index]
    torch.testing.assert_close(world.normals, normals, atol=1e-4, rtol=0)
    assert bound.sh.shape[1] == 8 and not bound.sh.any() and bound.scales[0, 0] == THICKNESS
    # Colours are those of the surface: between the corners', and of the right corner at a corner.
    corners = template.vertex_colors[template.faces[bound.face_index]] / 255.0
    weights = torch.cat([bound.barycentric, 1 - bound.barycentric.sum(1, keepdim=True)], 1).numpy()
    np.testing.assert_allclose(bound.dc, np.einsum("nk,nkc->nc", weights, corners), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("count", 0),
        ("head_share", 1.5),
        ("spread_by", "volume"),
        ("hidden_density", -0.1),
        ("touch", 0.0),
        ("touch", float("nan")),
        ("opacity", 1.0),
        ("sh_degree", 4),
    ],
)
def test_bad_settings_are_refused(name, value):
    with pytest.raises(InputError, match=name.replace("sh_degree", "degree")):
        SamplingConfig(**{name: value})


def test_a_body_without_a_head():
    template = random_template()
    with pytest.raises(InputError, match="head_share to None"):
        sample_on_mesh(template, SamplingConfig(count=100))
    assert len(sample_on_mesh(template, SamplingConfig(count=100, head_share=None, hidden_density=1.0))) == 100


def test_a_region_without_faces(template):
    nowhere = replace(template, faces=template.faces[head_faces(template)])
    with pytest.raises(InputError, match="rest"):
        sample_on_mesh(nowhere, SamplingConfig(count=100, head_share=0.5))
