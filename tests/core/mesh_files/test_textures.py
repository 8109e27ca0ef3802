"""Textured scans as other programs write them, against what trimesh reads: colours at the vertices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from smplxpp.clean import sanitize
from smplxpp.core.errors import GeometryWarning
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh

SIZE = 64


def _picture(seed: int) -> Image.Image:
    """A smooth picture: a texel farther on the colour is nearly the same."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, np.pi, SIZE), np.linspace(0, np.pi, SIZE))
    waves = [100 + 60 * np.sin(x + rng.uniform(0, 6)) * np.cos(y + rng.uniform(0, 6)) for _ in range(3)]
    return Image.fromarray(np.stack(waves, axis=2).astype(np.uint8))


def _ball(seed: int) -> trimesh.Trimesh:
    """A textured ball, wrapped as a map of the earth, so that it has a seam and two poles."""
    ball = trimesh.creation.uv_sphere(radius=0.4, count=[16, 16])
    middle = ball.triangles_center
    vertices, faces = ball.triangles.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3)
    turn = np.arctan2(vertices[:, 1], vertices[:, 0]) / (2 * np.pi) + 0.5
    about = np.repeat(np.arctan2(middle[:, 1], middle[:, 0]) / (2 * np.pi) + 0.5, 3)
    turn += np.rint(about - turn)  # the corners of a face beside the seam lie on its own side of it
    uv = np.stack([np.clip(turn, 0, 1), np.clip(vertices[:, 2] / 0.8 + 0.5, 0, 1)], axis=1)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=_picture(seed), baseColorFactor=[255] * 4)
    textured = trimesh.Trimesh(vertices, faces, process=False)
    textured.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return textured


def _scene() -> trimesh.Scene:
    """Two balls with materials of their own, turned, scaled and moved by nodes below each other."""
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.7, [0, 1, 0], [0.1, 0, 0])
    scene.add_geometry(_ball(0), node_name="a", geom_name="a", transform=turn)
    move = np.diag([2.0, 2.0, 2.0, 1.0])
    move[:3, 3] = [1.5, 0.2, 0]
    scene.add_geometry(_ball(1), node_name="b", geom_name="b", parent_node_name="a", transform=move)
    return scene


def _by_trimesh(scene: trimesh.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Places and colours of all vertices, as trimesh has them."""
    places, colors = [], []
    for part in scene.dump():
        places.append(part.vertices)
        colors.append(part.visual.material.to_color(part.visual.uv)[:, :3])
    return np.concatenate(places), np.concatenate(colors)


def _differences(raw, scene: trimesh.Scene) -> np.ndarray:
    """The difference of each vertex's colour from the most alike of those that trimesh has at its place."""
    places, colors = _by_trimesh(scene)
    near = cKDTree(places).query_ball_point(raw.vertices, 1e-5)
    assert all(near)
    return np.array(
        [
            np.abs(colors[k].astype(int) - own.astype(int)).max(axis=1).min()
            for k, own in zip(near, raw.vertex_colors, strict=True)
        ]
    )


def test_glb_of_two_materials_below_nodes_has_trimeshs_colours(tmp_path: Path):
    scene = _scene()
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    read_back = trimesh.load(tmp_path / "a.glb", process=False)
    raw = read_raw_mesh(tmp_path / "a.glb")
    difference = _differences(raw, read_back)
    # A texel's side: the two round coordinates to texels in different ways.
    assert difference.max() <= 14 and np.median(difference) <= 2


def test_obj_with_materials_has_trimeshs_colours(tmp_path: Path):
    ball = _ball(2)
    ball.visual.material = ball.visual.material.to_simple()
    ball.export(tmp_path / "a.obj")
    raw = read_raw_mesh(tmp_path / "a.obj")
    difference = _differences(raw, trimesh.Scene([trimesh.load(tmp_path / "a.obj", process=False)]))
    assert difference.max() <= 14 and np.median(difference) <= 2


@pytest.mark.parametrize("loose", [0, 40])
def test_vertices_split_at_seams_are_welded_with_the_mean_of_their_colours(tmp_path: Path, loose: int):
    ball = _ball(3)
    picture = np.asarray(ball.visual.material.baseColorTexture).copy()
    picture[:, -3:] = np.minimum(picture[:, -3:].astype(int) + loose, 255)  # the seam's other side
    ball.visual.material.baseColorTexture = Image.fromarray(picture)
    (tmp_path / "a.glb").write_bytes(trimesh.Scene([ball]).export(file_type="glb"))
    raw = read_raw_mesh(tmp_path / "a.glb")
    with pytest.warns(GeometryWarning, match="welded"):
        clean = sanitize(raw.vertices, raw.faces)
    assert clean.mesh.vertex_count < len(raw.vertices) and not len(clean.mesh.border_edges)
    colors = clean.mean_colors(raw.vertex_colors)
    tree = cKDTree(clean.mesh.vertices)
    _, of_raw = tree.query(raw.vertices)
    expected = np.stack([raw.vertex_colors[of_raw == k].mean(axis=0) for k in range(clean.mesh.vertex_count)])
    np.testing.assert_allclose(colors, expected, atol=0.51)
