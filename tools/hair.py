"""Make a bob of hair: the helper's hair strips and the scalp, thickened into one shell over the head."""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Float

from smplxpp.core.mesh import TriangleMesh, concatenate_meshes
from smplxpp.core.signed_distance import SignedDistanceField, barycentric_coordinates
from smplxpp.people.cloth_mesh import ClothMesh, clip, diffuse, smooth, submesh
from smplxpp.people.textures import smooth_noise
from tools.garments import DressForm, largest_component, with_clean_weights


def make_hair(form: DressForm, *, seed: int, radius: float = 0.010, cell: float = 0.005) -> ClothMesh:
    """Make an open sheet over scalp and neck: the level set `radius` metres around strips and scalp, off the skin."""
    skeleton = _skeleton(form)
    low = skeleton.vertices.min(axis=0) - 4 * radius
    size = np.ceil((skeleton.vertices.max(axis=0) + 4 * radius - low) / cell).astype(int)
    grid = low + cell * np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1).reshape(-1, 3)
    grid_order = grid.reshape(*size, 3).transpose(2, 1, 0, 3).reshape(-1, 3)  # x fastest, as igl wants it
    strands = np.sqrt(igl.point_mesh_squared_distance(grid_order, skeleton.vertices, skeleton.faces)[0]) - radius
    skin_field = SignedDistanceField(form.body, solid=True)
    level = np.minimum(strands, skin_field.query(grid_order).distance)
    vertices, faces, _ = igl.marching_cubes(level, np.ascontiguousarray(grid_order), *map(int, size), 0.0)
    shell = TriangleMesh(vertices, faces)
    if (shell.face_cross * (shell.triangles.mean(axis=1) - vertices.mean(axis=0))).sum() < 0:
        shell = TriangleMesh(vertices, faces[:, ::-1])
    shell = shell.with_vertices(smooth(shell, shell.vertices, steps=10))

    cloth = ClothMesh(shell.vertices, shell.faces, _closest_weights(form, skeleton, shell.vertices))
    cloth = clip(cloth, skin_field.query(cloth.vertices).distance - 0.5 * radius)
    # What is far below the head came with the shoulders' skin.
    cloth = largest_component(clip(cloth, cloth.vertices[:, 1] - skeleton.vertices[:, 1].min() + radius))
    strands = smooth_noise(cloth.vertices, scale=(0.008, 0.25, 0.008), seed=seed)
    vertices = cloth.vertices + 0.0014 * strands[:, None] * cloth.mesh.vertex_normals
    weights = diffuse(cloth.mesh, cloth.weights, radius=0.04)
    return with_clean_weights(ClothMesh(vertices, cloth.faces, weights))


def _skeleton(form: DressForm) -> TriangleMesh:
    """Return scalp and shortened strips without those that hang before the face."""
    head, eye, neck = form.joints["head"], form.joints["left_eye_smplhf"], form.joints["neck"]
    strips = form.helper("helper-hair")
    strips = clip(strips, strips.vertices[:, 1] - neck[1] - 0.045)
    x, y, z = strips.vertices.T
    before_face = (z > eye[2] - 0.075) & (np.abs(x) < 0.085) & (y < eye[1] + 0.035)
    strips = submesh(strips, ~before_face[strips.faces].any(axis=1))
    x, y, z = form.body.vertices.T
    # A hairline that rises from behind the ears over the temples to the forehead.
    hairline = eye[1] - 0.05 + 1.15 * np.clip(z - (head[2] - 0.005), 0, None)
    scalp = (y > hairline) & (y > head[1])
    return concatenate_meshes([strips.mesh, form.body.submesh(scalp[form.body.faces].all(axis=1))[0]])


def _closest_weights(
    form: DressForm, skeleton: TriangleMesh, points: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "P J"]:
    """Return the authored weights at the closest point of the skeleton; its vertices are the form's own."""
    whole = ClothMesh(form.vertices, form.base.faces, form.base.weights)
    sources = [submesh(whole, form.base.face_group == group) for group in ("helper-hair", "body")]
    mesh = concatenate_meshes([source.mesh for source in sources])
    weights = np.concatenate([source.weights for source in sources])
    near = igl.point_mesh_squared_distance(points, skeleton.vertices, skeleton.faces)[2]
    _, face, closest = igl.point_mesh_squared_distance(np.ascontiguousarray(near), mesh.vertices, mesh.faces)
    bary = barycentric_coordinates(closest, mesh.triangles[face])
    return np.einsum("pk,pkj->pj", bary, weights[mesh.faces[face]])
