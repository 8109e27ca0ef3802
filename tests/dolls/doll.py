"""A small person before cameras: made of a few parts, photographed by the z-buffer, written as a capture.

The variants lie beside: `standing` is two spheres seen from all around, `dancing` turns and nods in a loose dress,
`swaying` nods in a skirt and has true surfaces. Each is so small that a stage of training takes a second.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from smplxpp.body import load_body
from smplxpp.core import BodyParams, Camera, SkinWeights, TriangleMesh
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template
from tests.template.bodies import small_body


@dataclass(frozen=True)
class Part:
    """A piece of a doll: its vertices in metres, the joints it follows with their weights, its label."""

    vertices: np.ndarray
    faces: np.ndarray
    joints: Mapping[str, float]
    label: int = 0


@dataclass(frozen=True, eq=False)
class Doll:
    """A template with what cameras see of it, frame by frame.

    Args:
        name: of its capture.
        template: The body, with its clothes if it has any.
        cameras: By name.
        held_out: Names of the cameras that are for evaluation alone.
        params: The pose of every frame.
        surfaces: (V, 3) what the cameras see in every frame, metres.
        scanned: (V, 3) the true surfaces that the capture has, by frame.
        novel_frames: The held-out frames, one after another.
        stripes: Radians of the painted stripes' phase in a metre of height.
        supersampling: Each pixel is the mean of so many squared.
    """

    name: str
    template: Template
    cameras: Mapping[str, Camera]
    held_out: tuple[str, ...]
    params: tuple[BodyParams, ...]
    surfaces: tuple[np.ndarray, ...]
    scanned: Mapping[int, np.ndarray] = field(default_factory=dict)
    novel_frames: tuple[int, ...] = ()
    stripes: float = 30.0
    supersampling: int = 3

    @cached_property
    def photographs(self) -> list[dict[str, tuple[np.ndarray, np.ndarray]]]:
        """Colour on black and opacity, uint8, by frame and camera; frames that share a surface share them."""
        made: dict[int, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
        for surface in self.surfaces:
            if id(surface) not in made:
                made[id(surface)] = {name: self._photograph(surface, one) for name, one in self.cameras.items()}
        return [made[id(surface)] for surface in self.surfaces]

    @property
    def images(self) -> dict[str, np.ndarray]:
        """The colour images of frame 0, by camera."""
        return {name: color for name, (color, _) in self.photographs[0].items()}

    @property
    def masks(self) -> dict[str, np.ndarray]:
        """The opacities of frame 0, by camera."""
        return {name: mask for name, (_, mask) in self.photographs[0].items()}

    def write_capture(self, root: Path) -> Path:
        """Write the capture in the simple layout; return its folder."""
        for frame, views in enumerate(self.photographs):
            for name, seen in views.items():
                for folder, tag, image in zip(("rgbs", "masks"), ("rgb", "mask"), seen, strict=True):
                    path = root / folder / name / f"{name}_{tag}{frame:06d}.png"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    Image.fromarray(image).save(path, compress_level=1)
        (root / "cameras.json").write_text(json.dumps({"cameras": [_entry(one) for one in self.cameras.values()]}))
        about = {"name": self.name, "novel_views": list(self.held_out)}
        if self.novel_frames:
            about["novel_pose_frames"] = [self.novel_frames[0], self.novel_frames[-1]]
        (root / "capture.json").write_text(json.dumps(about))
        (root / "params").mkdir()
        for frame, params in enumerate(self.params):
            params.save(root / "params" / f"{frame:06d}.npz")
        if self.scanned:
            (root / "geometry").mkdir()
            np.savez(root / "geometry" / "topology.npz", faces=self.template.faces)
            for frame, vertices in self.scanned.items():
                np.savez(root / "geometry" / f"frame_{frame:06d}.npz", verts=vertices)
        return root

    def write_run(self, run: Path) -> Path:
        """Write a run that holds nothing but the template; return its folder."""
        (run / "60_assemble").mkdir(parents=True)
        self.template.save(run / "60_assemble" / "smplxpp.npz")
        return run

    def _photograph(self, surface: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Colour times opacity and opacity; the paint stays on the surface as it moves."""
        n = self.supersampling
        K = camera.K.copy()
        K[:2] *= n
        fine = Camera(K, camera.cam_from_world, n * camera.width, n * camera.height)
        mesh = TriangleMesh(surface, self.template.faces)
        maps = rasterize_mesh(mesh, fine, threads=1)
        points = maps.interpolate(mesh.faces, self.template.vertices).reshape(-1, 3)
        colors = (paint(points, self.stripes) * maps.mask.reshape(-1, 1)).reshape(*maps.mask.shape, 3)

        def shrink(image: np.ndarray) -> np.ndarray:
            blocks = image.reshape(camera.height, n, camera.width, n, -1).mean((1, 3))
            return np.round(255.0 * blocks).astype(np.uint8)

        return shrink(colors), shrink(maps.mask[..., None].astype(float))[..., 0]


def paint(points: np.ndarray, stripes: float) -> np.ndarray:
    """(N, 3) colours in [0, 1] of points on a doll at rest: soft stripes, another hue on every side."""
    x, y, z = points.T
    return np.stack([0.5 + 0.3 * np.sin(stripes * y), 0.5 + 0.4 * np.tanh(4 * x), 0.5 + 0.4 * np.tanh(4 * z)], axis=1)


def ball(
    radii: tuple[float, float, float] | float,
    height: float,
    joints: Mapping[str, float],
    *,
    subdivisions: int,
    label: int = 0,
) -> Part:
    """Make an ellipsoid about the axis of the doll."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Part(sphere.vertices * radii + (0.0, height, 0.0), sphere.faces, joints, label)


def make_template(
    body: Sequence[Part],
    garments: Mapping[str, Part] | None = None,
    *,
    bases_changed: Mapping[str, np.ndarray] | None = None,
    **changes: object,
) -> Template:
    """Make a template of parts: the body's first, then its clothes, by name.

    Every body vertex has the same share in every joint, there are two shapes that move nothing and no expression, and
    clothes lie on the body's first vertices; `bases_changed` are arguments of `small_body` that differ,
    `changes` fields of `Template`.
    """
    garments = garments or {}
    parts, joints = [*body, *garments.values()], load_body()
    sizes = [len(part.vertices) for part in parts]
    starts, count, own = np.cumsum([0, *sizes]), sum(sizes[: len(body)]), sum(sizes)
    weights = np.zeros((own, len(joints.joint_names)))
    for part, start in zip(parts, starts[:-1], strict=True):
        for joint, weight in part.joints.items():
            weights[start : start + len(part.vertices), joints.joint_names.index(joint)] = weight
    bases = {
        "joint_regressor": np.full((len(joints.joint_names), count), 1.0 / count),
        "parents": joints.parents,
        "joint_names": joints.joint_names,
        "shapedirs": np.zeros((count, 3, 2)),
        "exprdirs": np.zeros((count, 3, 0)),
    }
    fields = {
        "vertices": np.concatenate([part.vertices for part in parts]),
        "faces": np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]),
        "vertex_labels": np.repeat([part.label for part in parts], sizes),
        "vertex_part": np.repeat([0] * len(body) + list(range(1, len(garments) + 1)), sizes),
        "part_names": ("body", *garments),
        "vertex_colors": np.full((own, 3), 128),
        "weights": SkinWeights.from_dense(weights),
        "body": small_body(**{**bases, **(bases_changed or {})}),
        "betas": np.zeros(2),
        "body_index": np.concatenate([np.arange(count), np.zeros(own - count)]),
        "scan_index": np.full(own, -1),
    }
    return Template(**{**fields, **changes})


def place_camera(
    name: str,
    degrees: float,
    *,
    size: tuple[int, int],
    height: float,
    target: float,
    distance: float = 2.2,
    fov: float = 30.0,
) -> Camera:
    """Make a camera on a circle about the doll.

    Args:
        name: of it.
        degrees: About the axis from the doll's front.
        size: Pixels of its image, width before height.
        height: The camera's, metres.
        target: Height on the axis that it looks at, metres.
        distance: From the axis, metres.
        fov: Vertical field of view, degrees.
    """
    angle = np.radians(degrees)
    eye = np.array([distance * np.sin(angle), height, distance * np.cos(angle)])
    at = np.array([0.0, target, 0.0])
    camera = Camera.look_at(eye=eye, target=at, fov_y_deg=fov, width=size[0], height=size[1])
    return Camera(camera.K, camera.cam_from_world, *size, name=name)


def _entry(camera: Camera) -> dict[str, object]:
    return {
        "name": camera.name,
        "w": camera.width,
        "h": camera.height,
        "K": camera.K.tolist(),
        "R": camera.cam_from_world[:3, :3].tolist(),
        "T": camera.cam_from_world[:3, 3].tolist(),
    }
