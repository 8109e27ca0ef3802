"""Cut shirt, skirt and shoes from the base mesh's helper geometry, which fits every body and has authored weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.topology import face_components
from smplxpp.people.cloth_mesh import ClothMesh, clip, diffuse, lift_outside, loop_subdivide, smooth, submesh
from smplxpp.people.textures import ramp, smooth_noise
from tools.anny_base import JOINT_NAMES, BaseMesh


@dataclass(frozen=True, eq=False)
class DressForm:
    """A body in the T-pose and the helper geometry around it.

    Attributes:
        base: the mesh that topology, groups and weights come from.
        vertices: all vertices of the base mesh at the person's shape.
        joints: places of the joints by name.
        body: the skin alone.
    """

    base: BaseMesh
    vertices: Float[np.ndarray, "N 3"]
    joints: dict[str, Float[np.ndarray, " 3"]]
    body: TriangleMesh

    @staticmethod
    def of(base: BaseMesh, betas: Float[np.ndarray, " K"]) -> DressForm:
        """Make the form for shape coefficients."""
        apose = base.vertices + base.shape_dirs @ betas
        joints = base.joints + base.joint_shape_dirs @ betas
        vertices = base.tpose_vertices(apose, joints)
        body = TriangleMesh(vertices, base.faces).submesh(base.face_group == "body")[0]
        named = dict(zip(JOINT_NAMES, base.tpose_joints(joints), strict=True))
        return DressForm(base, vertices, named, body)

    def helper(self, group: str) -> ClothMesh:
        """Return one group of helper faces with its authored weights."""
        whole = ClothMesh(self.vertices, self.base.faces, self.base.weights)
        return submesh(whole, self.base.face_group == group)


def make_shirt(form: DressForm, *, under: TriangleMesh, seed: int) -> ClothMesh:
    """Make a short-sleeved shirt, worn over `under` (the skirt's waist)."""
    joints = form.joints
    shoulder, elbow, hip = joints["left_shoulder"], joints["left_elbow"], joints["left_hip"]
    cloth = loop_subdivide(form.helper("helper-tights"), 2)
    x, y, z = cloth.vertices.T
    sleeve_end = shoulder[0] + 0.62 * (elbow[0] - shoulder[0])
    hem = hip[1] + 0.045
    cloth = clip(cloth, y - hem)
    x = cloth.vertices[:, 0]
    cloth = clip(cloth, sleeve_end - np.abs(x))
    x, y, z = cloth.vertices.T
    # A round neck: what a vertical cylinder about the neck cuts from the shoulders and the upper chest.
    neck = joints["neck"]
    round_neck = np.hypot(x, z - neck[2] - 0.018) - 0.070
    cloth = clip(cloth, np.maximum(round_neck, neck[1] - 0.13 - y))
    cloth = largest_component(cloth)

    x, y, _ = cloth.vertices.T
    on_sleeve = ramp(np.abs(x), shoulder[0] * 0.95, shoulder[0] * 1.25)
    low = ramp(y, shoulder[1] - 0.08, hem)  # 0 at the chest, 1 at the hem
    mesh = cloth.mesh
    # Cloth bridges hollows: fair the torso strongly, then give ease, then fold.
    faired = smooth(mesh, cloth.vertices, steps=60)
    hang = (0.9 * low * (1 - on_sleeve))[:, None]
    vertices = (1 - hang) * smooth(mesh, cloth.vertices, steps=8) + hang * faired
    normals = mesh.with_vertices(vertices).vertex_normals
    ease = 0.004 + 0.016 * low * (1 - on_sleeve) + 0.009 * on_sleeve * ramp(np.abs(x), shoulder[0], sleeve_end)
    drapes = smooth_noise(vertices, scale=(0.022, 0.16, 0.022), seed=seed)
    creases = smooth_noise(vertices, scale=(0.03, 0.03, 0.05), seed=seed + 1)
    folds = (0.0015 + 0.0055 * low) * (1 - on_sleeve) * drapes + (0.0012 + 0.002 * on_sleeve) * creases
    vertices = vertices + (ease + folds)[:, None] * normals
    vertices = lift_outside(mesh.with_vertices(vertices), form.body, clearance=0.004, solid=True)
    vertices = lift_outside(mesh.with_vertices(vertices), under, clearance=0.004, solid=False)
    return with_clean_weights(cloth.with_vertices(smooth(mesh, vertices, steps=2)))


def make_skirt(form: DressForm, *, seed: int) -> ClothMesh:
    """Make a flared, knee-length skirt with folds that open towards the hem.

    The helper's authored weights jump from leg to leg along the middle: they are diffused, which leaves smooth blends.
    """
    joints = form.joints
    waist = joints["spine1"][1] - 0.03
    hem = joints["left_knee"][1] + 0.035
    cloth = loop_subdivide(_mended(form.helper("helper-skirt")), 1)
    cloth = loop_subdivide(cloth.with_vertices(smooth(cloth.mesh, cloth.vertices, steps=8)), 1)
    cloth = clip(cloth, waist - cloth.vertices[:, 1])
    cloth = clip(cloth, cloth.vertices[:, 1] - hem)
    cloth = largest_component(cloth)

    mesh = cloth.mesh
    vertices = smooth(mesh, cloth.vertices, steps=20)
    down = ramp(vertices[:, 1], waist - 0.06, hem)
    centre = np.array([0.0, joints["pelvis"][2]])
    flat = vertices[:, [0, 2]] - centre
    angle = np.arctan2(flat[:, 1], flat[:, 0])
    folds = _pleats(angle, vertices[:, 1], seed=seed)
    outward = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    reach = 0.004 + 0.055 * down + (0.001 + 0.025 * down) * folds
    vertices = vertices.copy()
    vertices[:, [0, 2]] += reach[:, None] * outward
    vertices = lift_outside(mesh.with_vertices(vertices), form.body, clearance=0.005, solid=True)
    vertices = smooth(mesh, vertices, steps=3)
    weights = diffuse(mesh.with_vertices(vertices), cloth.weights, radius=0.06)
    return with_clean_weights(ClothMesh(vertices, cloth.faces, weights))


def make_shoes(form: DressForm) -> ClothMesh:
    """Make a pair of low shoes with flat soles around the helper tights' feet, whose toes are one."""
    ankle, toes = form.joints["left_ankle"], form.joints["left_foot"]
    cloth = loop_subdivide(form.helper("helper-tights"), 1)
    z = cloth.vertices[:, 2]
    # The opening rises from the instep to the heel.
    opening = ankle[1] - 0.012 - 0.022 * ramp(z, ankle[2], toes[2] - 0.03)
    cloth = loop_subdivide(clip(cloth, opening - cloth.vertices[:, 1]), 1)
    mesh = cloth.mesh
    vertices = smooth(mesh, cloth.vertices, steps=12)
    ground = form.body.vertices[:, 1].min()
    sole = ramp(vertices[:, 1], ground + 0.035, ground + 0.004)
    normals = mesh.with_vertices(vertices).vertex_normals
    vertices = vertices + (0.005 + 0.004 * sole)[:, None] * normals
    vertices = lift_outside(mesh.with_vertices(vertices), form.body, clearance=0.004, solid=True)
    # A flat sole: everything near the ground goes down to one plane, softly.
    floor = ground - 0.012
    height = vertices[:, 1] - floor
    vertices[:, 1] = floor + np.where(height < 0.03, 0.03 * np.clip((height - 0.013) / 0.017, 0, 1) ** 1.5, height)
    return with_clean_weights(cloth.with_vertices(smooth(mesh, vertices, steps=1)))


def _pleats(angle: Float[np.ndarray, " N"], y: Float[np.ndarray, " N"], *, seed: int) -> Float[np.ndarray, " N"]:
    """Return folds around the axis in [-1, 1]: a few harmonics whose phase drifts a little with the height."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(angle)
    for harmonic in (7, 9, 11, 14):
        phase, drift = rng.uniform(0, 2 * np.pi), rng.normal(0, 1.2)
        total += rng.uniform(0.5, 1.0) * np.sin(harmonic * angle + phase + drift * y)
    return total / 2.4


def _mended(skirt: ClothMesh) -> ClothMesh:
    """Fair the seams of the helper skirt between the legs: there its vertices follow one leg each."""
    mesh = skirt.mesh
    middle = np.exp(-((skirt.vertices[:, 0] / 0.05) ** 2))[:, None]
    return skirt.with_vertices((1 - middle) * skirt.vertices + middle * smooth(mesh, skirt.vertices, steps=30))


def largest_component(cloth: ClothMesh) -> ClothMesh:
    """Return the connected component with the most faces."""
    component = face_components(cloth.faces)
    return submesh(cloth, component == np.argmax(np.bincount(component)))


def with_clean_weights(cloth: ClothMesh) -> ClothMesh:
    """Return the garment with weights without dust, rows summing to 1."""
    weights = np.where(cloth.weights < 2e-3, 0.0, cloth.weights)
    return ClothMesh(cloth.vertices, cloth.faces, weights / weights.sum(axis=1, keepdims=True))
