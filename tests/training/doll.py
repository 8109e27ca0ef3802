"""A doll of two spheres before a ring of cameras: a capture and a run so small that a fit takes a second."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from smplxpp.body import load_body
from smplxpp.core.camera import Camera
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template
from tests.template.bodies import small_body

WIDTH, HEIGHT = 64, 80
TRAIN, HELD_OUT = ("Ring0", "Ring1", "Ring2", "Ring3", "Ring4", "Ring5", "Face"), ("Held0", "Held1")
SUPERSAMPLING = 4


@dataclass(frozen=True)
class Doll:
    """Template, cameras by name, and what they see: colour on black and opacity, uint8."""

    template: Template
    cameras: dict[str, Camera]
    images: dict[str, np.ndarray]
    masks: dict[str, np.ndarray]


def paint(points: np.ndarray) -> np.ndarray:
    """(N, 3) colours in [0, 1] of points on the doll: soft stripes, another hue on every side."""
    x, y, z = points.T
    stripe = 0.5 + 0.3 * np.sin(40.0 * y)
    return np.stack([stripe, 0.5 + 0.4 * np.tanh(4 * x), 0.5 + 0.4 * np.tanh(4 * z)], axis=1)


@cache
def doll() -> Doll:
    """Deterministic. The template's own colours are one grey: all colour comes from the images."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    torso = ball.vertices * (0.22, 0.3, 0.16) + (0.0, 0.35, 0.0)
    head = ball.vertices * 0.13 + (0.0, 0.78, 0.0)
    vertices = np.concatenate([torso, head])
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    template = _template(vertices, faces)
    cameras = {name: _camera(name, 60.0 * k, 0.9) for k, name in enumerate(TRAIN[:-1])}
    cameras["Face"] = _camera("Face", 15.0, 0.8, target=(0, 0.78, 0), fov=14.0)
    cameras |= {name: _camera(name, 30.0 + 180.0 * k, 0.7) for k, name in enumerate(HELD_OUT)}
    images, masks = {}, {}
    for name, camera in cameras.items():
        images[name], masks[name] = _photograph(template.mesh, camera)
    return Doll(template, cameras, images, masks)


def write_capture(root: Path) -> Path:
    """The doll as a capture in the simple layout, frame 0."""
    it = doll()
    for name in it.cameras:
        for folder, tag, image in (("rgbs", "rgb", it.images[name]), ("masks", "mask", it.masks[name])):
            path = root / folder / name / f"{name}_{tag}000000.png"
            path.parent.mkdir(parents=True)
            Image.fromarray(image).save(path)
    entries = [
        {
            "name": name,
            "w": c.width,
            "h": c.height,
            "K": c.K.tolist(),
            "R": c.cam_from_world[:3, :3].tolist(),
            "T": c.cam_from_world[:3, 3].tolist(),
        }
        for name, c in it.cameras.items()
    ]
    (root / "cameras.json").write_text(json.dumps({"cameras": entries}))
    (root / "capture.json").write_text(json.dumps({"name": "doll", "novel_views": list(HELD_OUT)}))
    (root / "params").mkdir()
    BodyParams.rest(betas=2, expressions=0).save(root / "params" / "000000.npz")
    return root


def write_run(run: Path) -> Path:
    """A run that holds nothing but the template."""
    (run / "60_assemble").mkdir(parents=True)
    doll().template.save(run / "60_assemble" / "smplxpp.npz")
    return run


def _template(vertices: np.ndarray, faces: np.ndarray) -> Template:
    count, body = len(vertices), load_body()
    joints = len(body.joint_names)
    weights = np.zeros((count, joints))
    weights[: count // 2, 0] = 1.0
    weights[count // 2 :, body.joint_names.index("head")] = 1.0
    return Template(
        vertices=vertices,
        faces=faces,
        vertex_labels=np.zeros(count),
        vertex_part=np.zeros(count),
        part_names=("body",),
        vertex_colors=np.full((count, 3), 128),
        weights=SkinWeights.from_dense(weights),
        body=small_body(
            joint_regressor=np.full((joints, count), 1.0 / count),
            parents=body.parents,
            joint_names=body.joint_names,
            shapedirs=np.zeros((count, 3, 2)),
            exprdirs=np.zeros((count, 3, 0)),
        ),
        betas=np.zeros(2),
        body_index=np.arange(count),
        scan_index=np.full(count, -1),
    )


def _camera(
    name: str, degrees: float, height: float, *, target: tuple[float, ...] = (0, 0.48, 0), fov: float = 30.0
) -> Camera:
    angle = np.radians(degrees)
    eye = np.array([2.2 * np.sin(angle), height, 2.2 * np.cos(angle)])
    camera = Camera.look_at(eye=eye, target=np.array(target, float), fov_y_deg=fov, width=WIDTH, height=HEIGHT)
    return Camera(camera.K, camera.cam_from_world, WIDTH, HEIGHT, name=name)


def _photograph(mesh: TriangleMesh, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Colour times opacity and opacity, each pixel the mean of many."""
    n = SUPERSAMPLING
    K = camera.K.copy()
    K[:2] *= n
    fine = Camera(K, camera.cam_from_world, n * camera.width, n * camera.height)
    maps = rasterize_mesh(mesh, fine, threads=1)
    points = maps.interpolate(mesh.faces, mesh.vertices).reshape(-1, 3)
    colors = (paint(points) * maps.mask.reshape(-1, 1)).reshape(*maps.mask.shape, 3)

    def shrink(image: np.ndarray) -> np.ndarray:
        blocks = image.reshape(camera.height, n, camera.width, n, -1).mean((1, 3))
        return np.round(255.0 * blocks).astype(np.uint8)

    return shrink(colors), shrink(maps.mask[..., None].astype(float))[..., 0]
