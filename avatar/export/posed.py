"""Show an avatar in one pose to other programs: splats of the world (`avatar.formats`), a texture of its template."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from avatar.formats.splats import Splats
from avatar.gaussians.binding import THICKNESS, BoundGaussians, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.models.student import Student
from avatar.rendering.avatar_view import render
from smplxpp.core import BodyParams, TriangleMesh, require_choice
from smplxpp.core.mesh_files.raw_mesh import FacePictures
from smplxpp.core.spherical_harmonics import C0, rotate_sh
from smplxpp.raster.viewpoints import turntable_cameras
from smplxpp.template.mouth import inside_of_mouth
from smplxpp.template.texture import TEXTURE_SIZES, Texture
from smplxpp.texture.atlas import Atlas, unwrap
from smplxpp.texture.bake import bake
from smplxpp.texture.painted_scan import PaintedScan
from smplxpp.texture.photographs import Photograph, PhotographPainter


def posed_splats(bound: BoundGaussians, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> Splats:
    """Return bound Gaussians as world-space splats of one pose, with harmonics rotated to the world.

    Viewers evaluate colours in the world's axes, but our coefficients refer to the triangles' frames: `rotate_sh`
    rotates them. `f_dc = (dc - 0.5) / C0`. Computed in float64, stored in float32.

    Args:
        bound: the local attributes.
        vertices: of the posed mesh, metres.
        faces: of the mesh that they are bound to.
    """
    with torch.no_grad():
        # Viewers know neither triangles nor their scale: take each Gaussian to the world, with thickness and tangential
        # scales in mean edge lengths, whose logarithm is added.
        bound = bound.to(dtype=torch.float64)
        frames = triangle_frames(vertices.double(), faces)
        world = world_from_frames(bound, frames)
        log_local = torch.cat([torch.full_like(bound.log_scales[:, :1], math.log(THICKNESS)), bound.log_scales], 1)
        arrays = {
            "means": world.means,
            "normals": world.normals,
            "f_dc": (bound.dc - 0.5) / C0,
            "f_rest": rotate_sh(bound.sh, frames.rotations[bound.face_index]),
            "opacity_logits": bound.opacity_logits,
            "log_scales": log_local + torch.log(frames.lengths[bound.face_index, None]),
            "quats": torch.nn.functional.normalize(world.quats, dim=-1),
        }
        return Splats(**{name: value.cpu().numpy() for name, value in arrays.items()})


def student_texture(student: Student, *, size: int = 2048) -> Texture:
    """Paint the student's appearance on its template: pictures of it from all around, as photographs are painted.

    It is drawn in the pose of its scan, twelve times whole and eight times its head. What no picture shows keeps the
    template's texture, or the colours of its vertices. The faces lie as in the template's texture, if it has one.

    Args:
        student: trained.
        size: texels a side.

    Raises:
        InputError: another size than a build offers.

    Example:
        >>> template = dataclasses.replace(student.rig.template, texture=student_texture(student))  # doctest: +SKIP
    """
    require_choice("texture size", str(size), [str(one) for one in TEXTURE_SIZES if one])
    rig, template = student.rig, student.rig.template
    body, params = template.body, student.origin.reference
    if params is None:
        params = BodyParams.rest(betas=0, expressions=body.num_expressions)
    # The surface that carries the Gaussians in this pose, and pictures of them from around it.
    pose = rig.pose(params)
    with torch.no_grad():
        mesh = TriangleMesh(rig.skin_to_numpy(pose, student.displacements(pose)), template.faces)
    cameras = turntable_cameras(mesh.vertices[np.unique(mesh.faces)], count=12, height=max(1024, size * 3 // 4))
    if "head" in body.joint_names:
        head = template.weights.dense()[:, body.joint_names.index("head")] > 0.5
        cameras += turntable_cameras(mesh.vertices[head], count=8, height=max(512, size // 2))
    photographs = [Photograph(camera, render(student, params, camera)) for camera in cameras]
    # Colours of what no picture shows.
    own, pictures = template.texture, None
    if own is not None:
        pictures = FacePictures(
            own.uv[own.face_uv].astype(np.float32),
            own.picture[template.vertex_part[template.faces[:, 0]]],
            tuple(partial(own.color_image, k) for k in range(len(own.colors))),
            (("clamp", "clamp"),) * len(own.colors),
        )
    scan = PaintedScan(mesh, template.vertex_colors, template.vertex_labels[template.faces[:, 0]], pictures)
    atlas = unwrap(template, body.uv) if own is None else Atlas(own.uv, own.face_uv, own.picture)
    made, _ = bake(
        template,
        mesh.vertices,
        atlas,
        scan,
        size=size,
        paint=PhotographPainter(mesh, photographs, scan.colors_at),
        fixed=inside_of_mouth(template),
        normals=False,
    )
    return replace(made, normals=() if own is None else own.normals)
