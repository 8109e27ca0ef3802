"""A doll of three spheres in a loose dress: six frames that move, so small that a stage of training takes a second."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

from avatar.data.sequence import AvatarSequence, SequenceConfig
from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.networks.teacher import TeacherConfig
from smplxpp.body import load_body
from smplxpp.capture import Capture, open_capture
from smplxpp.core.camera import Camera
from smplxpp.core.labels import LOWER
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template
from tests.template.bodies import small_body

WIDTH, HEIGHT = 48, 64
FRAMES, NOVEL_POSES = 6, (4, 5)
TRAIN, HELD_OUT = ("Ring0", "Ring1", "Ring2", "Ring3"), ("Held0",)
EXPRESSIONS = 2
TINY_TEACHER = TeacherConfig(
    in_size=16,
    out_size=32,
    bottleneck=4,
    channel_base=64,
    channel_max=8,
    style_size=4,
    style_layers=1,
    networks="shared",
    noise=False,
    zero_output=True,
)
TINY_FIELD = FieldConfig(width=8, hidden_layers=1, frequencies=2, code_size=4)


@cache
def template() -> Template:
    """Torso and head (the body), and a dress around the torso that follows two joints."""
    ball, body = trimesh.creation.icosphere(subdivisions=2), load_body()
    size = len(ball.vertices)
    torso = ball.vertices * (0.2, 0.28, 0.15) + (0.0, 0.35, 0.0)
    head = ball.vertices * 0.13 + (0.0, 0.78, 0.0)
    dress = ball.vertices * (0.25, 0.31, 0.19) + (0.0, 0.3, 0.0)
    joints = len(body.joint_names)
    weights = np.zeros((3 * size, joints))
    weights[:size, 0] = 1.0
    weights[size : 2 * size, body.joint_names.index("head")] = 1.0
    weights[2 * size :, 0], weights[2 * size :, body.joint_names.index("spine1")] = 0.6, 0.4
    # About where the body has them: the head turns about its neck.
    regressor = np.zeros((joints, 2 * size))
    regressor[:, np.argmin(torso[:, 1])] = 1.0
    regressor[body.joint_names.index("head")] = 0.0
    regressor[body.joint_names.index("head"), size + np.argmin(head[:, 1])] = 1.0
    smile = np.zeros((2 * size, 3, EXPRESSIONS))
    smile[size:, 2, 0], smile[size:, 1, 1] = 0.02, 0.01
    shapes = np.zeros((2 * size, 3, 2))
    shapes[:, 0, 0] = 0.02
    return Template(
        vertices=np.concatenate([torso, head, dress]),
        faces=np.concatenate([ball.faces + k * size for k in range(3)]),
        vertex_labels=np.repeat([0, 0, LOWER.id], size),
        vertex_part=np.repeat([0, 0, 1], size),
        part_names=("body", "dress"),
        vertex_colors=np.full((3 * size, 3), 128),
        weights=SkinWeights.from_dense(weights),
        body=small_body(
            joint_regressor=regressor,
            parents=body.parents,
            joint_names=body.joint_names,
            shapedirs=shapes,
            exprdirs=smile,
        ),
        betas=np.zeros(2),
        body_index=np.concatenate([np.arange(2 * size), np.arange(size)]),
        scan_index=np.full(3 * size, -1),
    )


@cache
def dance() -> BodyParams:
    """The doll turns, walks a little, nods and smiles."""
    t = np.arange(FRAMES)[:, None] / FRAMES
    pose = np.zeros((FRAMES, 55, 3))
    pose[:, 0, 1:2] = 0.5 * t
    names = template().body.joint_names
    pose[:, names.index("head"), 0:1] = 0.4 * np.sin(5.0 * t)
    pose[:, names.index("spine1"), 2:3] = 0.3 * np.cos(4.0 * t)
    return BodyParams.from_full_pose(
        pose, betas=np.zeros((FRAMES, 2)), expression=np.concatenate([t, 1.0 - t], axis=1), transl=0.1 * t * [1, 0, 0]
    )


def cameras() -> dict[str, Camera]:
    """Four around the doll, and one that is held out."""
    return {name: _camera(name, angle) for name, angle in zip((*TRAIN, *HELD_OUT), (0, 90, 180, 270, 40), strict=True)}


def true_vertices(frame: int) -> np.ndarray:
    """(V, 3) posed, the dress swung to a side as skinning does not have it."""
    it = template()
    swing = 0.03 * np.sin(1.5 * frame) * it.cloth_mask
    return it.pose(dance().frame(frame))[0] + swing[:, None] * [1.0, 0.0, 0.0]


def write_dance(root: Path) -> Path:
    """The capture in the simple layout; the last two frames and one camera are held out."""
    it = template()
    for name, camera in cameras().items():
        for frame in range(FRAMES):
            color, mask = _photograph(it, it.mesh.with_vertices(true_vertices(frame)), camera)
            for folder, tag, image in (("rgbs", "rgb", color), ("masks", "mask", mask)):
                path = root / folder / name / f"{name}_{tag}{frame:06d}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(image).save(path)
    entries = [
        {
            "name": name,
            "w": WIDTH,
            "h": HEIGHT,
            "K": c.K.tolist(),
            "R": c.cam_from_world[:3, :3].tolist(),
            "T": c.cam_from_world[:3, 3].tolist(),
        }
        for name, c in cameras().items()
    ]
    (root / "cameras.json").write_text(json.dumps({"cameras": entries}))
    about = {"name": "dance", "novel_views": list(HELD_OUT), "novel_pose_frames": list(NOVEL_POSES)}
    (root / "capture.json").write_text(json.dumps(about))
    (root / "params").mkdir()
    for frame in range(FRAMES):
        dance().frame(frame).save(root / "params" / f"{frame:06d}.npz")
    return root


def write_dance_run(run: Path) -> Path:
    """A run that holds nothing but the template."""
    (run / "60_assemble").mkdir(parents=True)
    template().save(run / "60_assemble" / "smplxpp.npz")
    return run


def gaussians(count: int = 400) -> BoundGaussians:
    """On the template, coloured grey as it is."""
    return sample_on_mesh(template(), SamplingConfig(count=count, sh_degree=1))


def varied(bound: BoundGaussians, seed: int = 0) -> BoundGaussians:
    """Gaussians with attributes that are all different from their start."""
    random = torch.Generator().manual_seed(seed)
    moved = {
        name: value + 0.1 * torch.randn(value.shape, generator=random)
        for name, value in bound.tensors.items()
        if name in ("log_scales", "quats", "opacity_logits", "dc", "sh")
    }
    return replace(bound, **moved)


def sequence(capture: Capture | Path, **config) -> AvatarSequence:
    """What a task is made on."""
    capture = open_capture(capture) if isinstance(capture, Path) else capture
    return AvatarSequence(capture, template(), SequenceConfig(**config))


def _camera(name: str, degrees: float) -> Camera:
    angle = np.radians(degrees)
    eye = np.array([2.2 * np.sin(angle), 0.7, 2.2 * np.cos(angle)])
    camera = Camera.look_at(eye=eye, target=np.array([0, 0.45, 0]), fov_y_deg=30.0, width=WIDTH, height=HEIGHT)
    return Camera(camera.K, camera.cam_from_world, WIDTH, HEIGHT, name=name)


def _photograph(it: Template, posed: TriangleMesh, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Colours that stay on the surface, and opacity; each pixel the mean of many."""
    n = 3
    K = camera.K.copy()
    K[:2] *= n
    maps = rasterize_mesh(posed, Camera(K, camera.cam_from_world, n * WIDTH, n * HEIGHT), threads=1)
    x, y, z = np.moveaxis(maps.interpolate(it.faces, it.vertices), -1, 0)
    paint = np.stack([0.5 + 0.3 * np.sin(30.0 * y), 0.5 + 0.4 * np.tanh(4 * x), 0.5 + 0.4 * np.tanh(4 * z)], axis=-1)

    def shrink(image: np.ndarray) -> np.ndarray:
        return np.round(255.0 * image.reshape(HEIGHT, n, WIDTH, n, -1).mean((1, 3))).astype(np.uint8)

    return shrink(paint * maps.mask[..., None]), shrink(maps.mask[..., None].astype(float))[..., 0]
