"""A doll in a skirt that sways as she nods: template, capture with true surfaces, presets of a second."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from avatar.gaussians.sampling import SamplingConfig
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.networks.presets import NetworkPreset
from avatar.models.networks.teacher import TeacherConfig
from avatar.training.engine.pretraining import PretrainConfig
from avatar.training.presets import TrainingPreset
from avatar.training.reference_fit.config import FitConfig
from avatar.training.student.bake import BakeConfig
from avatar.training.student.compensate import CompensateConfig
from avatar.training.teacher.fit_teacher import FitTeacherConfig
from avatar.training.tracking.track import Level, TrackConfig
from smplxpp.body import load_body
from smplxpp.capture import Capture, open_capture
from smplxpp.core.camera import Camera
from smplxpp.core.labels import LOWER, SKIN
from smplxpp.core.params import BodyParams
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template
from tests.template.bodies import small_body

WIDTH, HEIGHT = 48, 64
TRAIN, HELD_OUT = ("Ring0", "Ring1", "Ring2", "Ring3"), "Held"
ANGLES = (0.0, 0.3, -0.3, 0.15, 0.22)
"""Radians of her nod, frame by frame; the last frame is held out."""
SWAY = 0.25
"""Metres that the hem moves for a nod of one radian, which skinning knows nothing of."""


TORSO = 642
"""Vertices of the torso, which come first; the head's 162 follow."""


@cache
def template() -> Template:
    """Torso and head are the body, an open cone round the legs is the skirt."""
    body = load_body()
    ball, fine = (trimesh.creation.icosphere(subdivisions=k) for k in (2, 3))
    head = ball.vertices * 0.13 + (0.0, 0.80, 0.0)
    torso = fine.vertices * (0.18, 0.34, 0.13) + (0.0, 0.35, 0.0)
    cone = _cone(rings=7, sides=24)
    count, own = TORSO + len(head), TORSO + len(head) + len(cone.vertices)
    joints = len(body.joint_names)
    weights = np.zeros((own, joints))
    weights[:, 0] = 1.0
    weights[TORSO:count] = np.eye(joints)[body.joint_names.index("head")]
    rng = np.random.default_rng(0)
    return Template(
        vertices=np.concatenate([torso, head, cone.vertices]),
        faces=np.concatenate([fine.faces, ball.faces + TORSO, cone.faces + count]),
        vertex_labels=np.repeat([SKIN.id, LOWER.id], [count, own - count]),
        vertex_part=np.repeat([0, 1], [count, own - count]),
        part_names=("body", "lower"),
        vertex_colors=np.full((own, 3), 128),
        weights=SkinWeights.from_dense(weights),
        body=small_body(
            joint_regressor=np.full((joints, count), 1.0 / count),
            parents=body.parents,
            joint_names=body.joint_names,
            shapedirs=np.zeros((count, 3, 2)),
            exprdirs=0.002 * rng.normal(size=(count, 3, 2)),
        ),
        betas=np.zeros(2),
        body_index=np.concatenate([np.arange(count), np.zeros(own - count)]),
        scan_index=np.full(own, -1),
    )


def params(frame: int) -> BodyParams:
    """Her nod in a frame."""
    rest = BodyParams.rest(betas=2, expressions=2)
    pose = rest.body_pose.copy()
    pose[0, 3 * (template().body.joint_names.index("head") - 1) + 2] = ANGLES[frame]
    return replace(rest, body_pose=pose, expression=np.array([[ANGLES[frame], 0.5]]))


def truth(frame: int) -> np.ndarray:
    """(V, 3) true surface of a frame: skinned, the skirt swung to the side, most at its hem."""
    it = template()
    vertices = it.pose(params(frame))[0]
    skirt = it.vertex_part == 1
    top, bottom = it.vertices[skirt, 1].max(), it.vertices[skirt, 1].min()
    vertices[skirt, 0] += SWAY * ANGLES[frame] * (top - it.vertices[skirt, 1]) / (top - bottom)
    return vertices


def write_moving_capture(root: Path) -> Path:
    """Five frames from five cameras; the last frame and the last camera are held out."""
    cameras = {name: _camera(name, 90.0 * k) for k, name in enumerate(TRAIN)} | {HELD_OUT: _camera(HELD_OUT, 45.0)}
    colors = _paint(template().vertices)
    (root / "geometry").mkdir(parents=True)
    (root / "params").mkdir()
    np.savez(root / "geometry" / "topology.npz", faces=template().faces)
    for frame in range(len(ANGLES)):
        vertices = truth(frame)
        np.savez(root / "geometry" / f"frame_{frame:06d}.npz", verts=vertices)
        params(frame).save(root / "params" / f"{frame:06d}.npz")
        for name, camera in cameras.items():
            seen = _photograph(vertices, colors, camera)
            for folder, tag, image in zip(("rgbs", "masks"), ("rgb", "mask"), seen, strict=True):
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
        for name, c in cameras.items()
    ]
    (root / "cameras.json").write_text(json.dumps({"cameras": entries}))
    last = len(ANGLES) - 1
    about = {"name": "moving doll", "novel_views": [HELD_OUT], "novel_pose_frames": [last, last]}
    (root / "capture.json").write_text(json.dumps(about))
    return root


def open_moving(root: Path) -> Capture:
    """Written and opened."""
    return open_capture(write_moving_capture(root))


def write_moving_run(run: Path) -> Path:
    """A run that holds nothing but the template."""
    (run / "60_assemble").mkdir(parents=True)
    template().save(run / "60_assemble" / "smplxpp.npz")
    return run


def tiny_preset(iterations: int = 3) -> TrainingPreset:
    """All stages in a second, on 500 Gaussians."""
    teacher = TeacherConfig(
        networks="shared",
        in_size=32,
        out_size=64,
        bottleneck=8,
        channel_base=64,
        channel_max=8,
        style_size=8,
        style_layers=1,
        noise=False,
        zero_output=True,
    )
    track = TrackConfig(levels=(Level(0, 2, 2e-3),), control_points=60, views=2)
    shared = {
        "iterations": iterations,
        "evaluations": 1,
        "evaluated": 1,
        "null_share": 0.2,
        "weights": ReconstructionWeights(perceptual=0.0, alpha=0.1),
    }
    return TrainingPreset(
        networks=NetworkPreset(teacher, FieldConfig(width=16, hidden_layers=2, code_size=4)),
        fit=FitConfig(sampling=SamplingConfig(count=500), iterations=iterations, margin=4),
        teacher=FitTeacherConfig(
            **{k: v for k, v in shared.items() if k != "null_share"},
            pretrain=PretrainConfig(iterations=2, batch=2),
            lr=2e-3,
            attributes=0.5,
            track=track,
        ),
        bake=BakeConfig(**shared, lr=2e-3, views=2, pretrain=PretrainConfig(iterations=2, batch=3), imagined=2),
        compensate=CompensateConfig(**shared, lr=2e-3, poses_per_step=1, views=2),
        blend_shapes=BlendShapeConfig(head_shapes=2, body_shapes=3, width=8, jaw=True),
    )


def _cone(*, rings: int, sides: int) -> trimesh.Trimesh:
    height = np.linspace(0.25, -0.25, rings)
    radius = np.linspace(0.2, 0.34, rings)
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    vertices = np.stack(
        [np.outer(radius, np.sin(angle)), np.repeat(height[:, None], sides, 1), np.outer(radius, np.cos(angle))], -1
    )
    k, j = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    a, b = k * sides + j, k * sides + (j + 1) % sides
    faces = np.concatenate([np.stack([a, a + sides, b], -1), np.stack([b, a + sides, b + sides], -1)])
    return trimesh.Trimesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False)


def _paint(points: np.ndarray) -> np.ndarray:
    """(N, 3) colours in [0, 1] that stay on the surface: soft stripes, another hue on every side."""
    x, y, z = points.T
    return np.stack([0.5 + 0.3 * np.sin(25.0 * y), 0.5 + 0.4 * np.tanh(4 * x), 0.5 + 0.4 * np.tanh(4 * z)], axis=1)


def _camera(name: str, degrees: float) -> Camera:
    angle = np.radians(degrees)
    eye = np.array([2.6 * np.sin(angle), 0.6, 2.6 * np.cos(angle)])
    camera = Camera.look_at(eye=eye, target=np.array([0.0, 0.32, 0.0]), fov_y_deg=36.0, width=WIDTH, height=HEIGHT)
    return Camera(camera.K, camera.cam_from_world, WIDTH, HEIGHT, name=name)


def _photograph(vertices: np.ndarray, colors: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Colour times opacity and opacity, uint8, each pixel the mean of 3 x 3."""
    K = camera.K.copy()
    K[:2] *= 3
    mesh = template().mesh.with_vertices(vertices)
    maps = rasterize_mesh(mesh, Camera(K, camera.cam_from_world, 3 * WIDTH, 3 * HEIGHT), threads=1)
    image = np.concatenate([maps.interpolate(mesh.faces, colors), np.ones((*maps.mask.shape, 1))], axis=-1)
    image = (image * maps.mask[..., None]).reshape(HEIGHT, 3, WIDTH, 3, 4).mean((1, 3))
    image = np.round(255.0 * image).astype(np.uint8)
    return image[..., :3], image[..., 3]
