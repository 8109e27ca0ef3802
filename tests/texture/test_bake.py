"""Textures painted from a scan: every place of the surface has its own colour, hidden skin that of bare skin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.build.detail import simplified_template
from smplxpp.core import SKIN, UPPER, TriangleMesh
from smplxpp.core.mesh_files.raw_mesh import FacePictures, RawMesh
from smplxpp.core.mesh_files.texture import sample_bilinear
from smplxpp.core.surface_points import draw_on_surface
from smplxpp.core.topology import component_labels
from smplxpp.template.template import Template
from smplxpp.texture.atlas import texels_of, texture_stretch, unwrap
from smplxpp.texture.bake import bake
from smplxpp.texture.painted_scan import PaintedScan, pictures_of
from tests.export.templates import open_body_template, with_part

pytest.importorskip("xatlas", reason="unwrapping needs xatlas")
SKIN_TONE = np.array([200, 150, 120])


def painted(vertices: np.ndarray) -> np.ndarray:
    """Bands that are wider than a texel and narrower than most faces of clothes."""
    bands = np.sin(60.0 * vertices[:, 1:2]) * [30, 20, 10]
    return np.rint(SKIN_TONE + bands).astype(np.uint8)


@pytest.fixture(scope="module")
def person() -> Template:
    return open_body_template()


@pytest.fixture(scope="module")
def atlas(person):
    return unwrap(person, load_body().uv)


@pytest.mark.long
def test_every_point_has_the_scans_colour_and_hidden_skin_that_of_bare_skin(person, atlas):
    posed = person.vertices + [0.3, 0.0, -0.2]  # the scan stands elsewhere, as scans do
    mesh = TriangleMesh(posed, person.faces)
    hidden = (mesh.face_centers[:, 1] < 0.3) & (mesh.face_centers[:, 1] > -0.3)
    # What covers the waist is green, and near enough to the body to be taken for it but for its label.
    colors = painted(posed)
    colors[np.unique(mesh.faces[hidden])] = (0, 255, 0)
    scan = PaintedScan(mesh, colors, np.where(hidden, UPPER.id, SKIN.id))
    texture, report = bake(person, posed, atlas, scan, size=512, normals=False)
    textured = replace(person, texture=texture)
    face, barycentric = draw_on_surface(mesh, 20_000)
    image = textured.texture.color_image(0)
    uv = np.einsum("nk,nkd->nd", barycentric, texture.uv[texture.face_uv[face]])
    found = sample_bilinear(image, uv, wrap=("clamp", "clamp")).astype(float)
    wanted = np.einsum("nk,nkc->nc", barycentric, colors[mesh.faces[face]].astype(float))
    # Bare skin away from the cover's edge: half a step of a byte, the grain of JPEG, and half a texel of the bands.
    bare = np.abs(np.einsum("nk,nk->n", barycentric, posed[mesh.faces[face]][:, :, 1])) > 0.32
    away = np.abs(found - wanted)[bare].max(axis=1)
    assert np.percentile(away, 95) < 8 and away.mean() < 2.5
    # Under the cover no green, and no farther from the tone of skin than its bands are.
    assert np.abs(found[hidden[face]] - SKIN_TONE).max(axis=1).mean() < 40
    assert (found[hidden[face]][:, 1] < 200).mean() > 0.97
    assert 0.3 < report.seen < 0.95 and report.by_part == {"body": report.seen}
    again, _ = bake(person, posed, atlas, scan, size=512, normals=False)
    assert again.colors == texture.colors


@pytest.mark.long
def test_a_picture_a_part_has_that_parts_colours_and_the_body_lies_as_in_its_file(person):
    shirt = person.faces[(np.abs(person.mesh.face_centers[:, 1]) < 0.15)]
    worn = with_part(person, "upper", UPPER.id, shirt, 0.01)
    atlas = unwrap(worn, load_body().uv, layout="part")
    places, rows = load_body().uv
    np.testing.assert_allclose(
        atlas.uv[atlas.face_uv[: len(person.faces)]], (places * [1, -1] + [0, 1])[rows], atol=1e-12
    )
    red, blue = (200, 40, 40), (40, 40, 200)
    colors = np.where(worn.vertex_part[:, None] == 0, red, blue).astype(np.uint8)
    scan = PaintedScan(worn.mesh, colors, worn.vertex_labels[worn.faces[:, 0]])
    texture, report = bake(worn, worn.vertices, atlas, scan, size=256, normals=False)
    assert len(texture.colors) == 2 and texture.picture.tolist() == [0, 1] and set(report.by_part) == {"body", "upper"}
    for part, color in enumerate((red, blue)):
        faces = texture.face_uv[worn.vertex_part[worn.faces[:, 0]] == part]
        middles = texture.uv[faces].mean(axis=1)
        found = sample_bilinear(texture.color_image(part), middles, wrap=("clamp", "clamp"))
        assert np.percentile(np.abs(found.astype(int) - color).max(axis=1), 99) < 8


@pytest.mark.long
def test_a_level_of_detail_is_painted_anew_from_its_source(person, atlas):
    bands = replace(person, vertex_colors=painted(person.vertices))
    scan = PaintedScan(bands.mesh, bands.vertex_colors, np.full(len(bands.faces), SKIN.id))
    texture, _ = bake(bands, bands.vertices, atlas, scan, size=512, normals=False)
    level = simplified_template(replace(bands, texture=texture), 4000)
    assert 3500 < len(level.faces) < 4500 and level.texture.size == 1024
    face, barycentric = draw_on_surface(level.mesh, 5000)
    uv = np.einsum("nk,nkd->nd", barycentric, level.texture.uv[level.texture.face_uv[face]])
    found = sample_bilinear(level.texture.color_image(0), uv).astype(float)
    points = np.einsum("nk,nkd->nd", barycentric, level.mesh.triangles[face])
    # Faces of centimetres cut the bands' crests off by some bytes; other places of the person differ by 60.
    assert np.abs(found - painted(points)).max(axis=1).mean() < 6


def test_charts_do_not_overlap_stay_apart_and_keep_their_shape(person, atlas):
    # Faces of two charts never share a texel, and no texel of one touches another's.
    size = 512
    owner = np.full((size, size), -1)
    chart = component_labels(np.concatenate([atlas.face_uv[:, :2], atlas.face_uv[:, 1:]]), len(atlas.uv))
    for texels in texels_of(atlas, np.ones(len(atlas.face_uv), dtype=bool), size):
        owner[texels.row, texels.column] = chart[atlas.face_uv[texels.face, 0]]
    for a, b in ((owner[1:], owner[:-1]), (owner[:, 1:], owner[:, :-1])):
        assert not ((a != b) & (a >= 0) & (b >= 0)).any()
    assert 0.3 < (owner >= 0).mean()
    # Known stretch: a square onto a square has none, onto one of twice the width sqrt(5/4).
    square = TriangleMesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    flat = replace(atlas, uv=square.vertices[:, :2] / 2, face_uv=square.faces)
    np.testing.assert_allclose(texture_stretch(flat, square), (1.0, 1.0))
    np.testing.assert_allclose(
        texture_stretch(flat, square.with_vertices(square.vertices * [2, 1, 1])), (np.sqrt(5 / 4), np.sqrt(2))
    )


def test_a_face_that_the_repair_turned_round_keeps_its_corners_places():
    uv = np.array([[[0.1, 0.2], [0.9, 0.2], [0.1, 0.7]]], np.float32)
    pictures = FacePictures(uv, np.zeros(1, np.int64), (lambda: np.zeros((2, 2, 3), np.uint8),), (("clamp", "clamp"),))
    raw = RawMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]), pictures=pictures)
    turned = TriangleMesh(raw.vertices, raw.faces[:, ::-1])
    found = pictures_of(raw, turned, np.arange(3), np.zeros(1, np.int64))
    np.testing.assert_array_equal(found.uv[0], uv[0][::-1])
