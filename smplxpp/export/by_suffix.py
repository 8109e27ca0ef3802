"""Export a template in the format that a path's suffix names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.body.blendshapes import with_arkit_names
from smplxpp.body.layout import NAME_SCHEMES, OWN_NAMES
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.core import BodyParams, InputError, require_between, require_choice
from smplxpp.export.fbx import ROOT, write_fbx
from smplxpp.export.gltf import write_glb
from smplxpp.export.gltf_skin import MAX_INFLUENCES, with_joint_names
from smplxpp.export.obj import write_obj
from smplxpp.export.usd import write_usd
from smplxpp.export.vrm import checked_meta, write_vrm
from smplxpp.template.template import Template
from smplxpp.template.texture import TEXTURE_SIZES

_USD = (".usd", ".usda", ".usdc", ".usdz")
RIGGED = (".glb", ".fbx", ".vrm", *_USD)
"""Suffixes of files with a skeleton."""
SUFFIXES = (*RIGGED, ".obj", ".npz")
# Unreal's own skeletons begin with this bone.
_UNREAL_ROOT = "root"


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """What a rigged file may be asked for.

    Attributes:
        joint_names: whose names the joints have: one of `smplxpp.body.layout.NAME_SCHEMES`.
        max_influences: most joints of a vertex, 1 to 8; None: as many as the format holds.
        texture_size: texels a side of the pictures, at most as many as the build made; 0: the colours of the vertices
            alone. None: as the build made them.
        blender: Blender, or a Python with bpy, which writes FBX; None: as `smplxpp.export.fbx.blender_command` finds
            it.
        meta: of a VRM, name, authors, licence and terms by VRM's own names: `smplxpp.export.vrm.checked_meta`.

    Raises:
        InputError: a value that no format takes.
    """

    joint_names: str = OWN_NAMES
    max_influences: int | None = None
    texture_size: int | None = None
    blender: str | Path | None = None
    meta: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        require_choice("option joint_names", self.joint_names, NAME_SCHEMES)
        if self.max_influences is not None:
            require_between("option max_influences", self.max_influences, 1, MAX_INFLUENCES)
        if self.texture_size is not None:
            require_choice("option texture_size", str(self.texture_size), [str(size) for size in TEXTURE_SIZES])
        checked_meta(self.meta, name="me")

    def check(self, suffix: str) -> None:
        """Raise `InputError` for an option that has no effect on files of a suffix."""
        effects = {"joint_names": (*RIGGED, ".bvh"), "max_influences": RIGGED, "blender": (".fbx",), "meta": (".vrm",)}
        effects["texture_size"] = SUFFIXES
        for name, suffixes in effects.items():
            if getattr(self, name) != getattr(ExportOptions, name) and suffix not in suffixes:
                raise InputError(f"option {name}", expected=f"a file {', '.join(suffixes)}", received=suffix)


def export_template(
    path: str | Path,
    template: Template,
    *,
    animation: BodyParams | None = None,
    options: ExportOptions | None = None,
) -> Path:
    """Write a template as GLB, FBX, VRM, USD, OBJ or npz, by the suffix of the path; see `Template.export`.

    Args:
        path: of the file.
        template: body and parts in the T-pose.
        animation: T frames; OBJ takes one, VRM and npz none.
        options: what a rigged file may be asked for.

    Returns:
        The path.

    Raises:
        InputError: another suffix, frames or options that the format cannot hold, FBX without Blender.
        MissingExtraError: USD without usd-core.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError("export path", expected=f"a suffix of {', '.join(SUFFIXES)}", received=path.name)
    # A file without motion holds the T-pose (npz), or one pose (OBJ).
    frames, most = 0 if animation is None else len(animation), {".npz": 0, ".vrm": 0, ".obj": 1}.get(suffix)
    if most is not None and frames > most:
        raise InputError(
            "animation",
            expected=f"at most {most} frames in a file {suffix}",
            received=f"{frames} frames",
            remedy="export a motion as .glb or .usdc",
        )
    options = options or ExportOptions()
    options.check(suffix)
    template = with_texture_size(with_influences(template, options.max_influences), options.texture_size)
    # A VRM's bones are found by our names, before they get others.
    if suffix != ".vrm":
        template = with_joint_names(template, options.joint_names)
    # A motion places the person by itself; in the T-pose she stands on the floor. Our own files keep the body's frame.
    if animation is None and suffix != ".npz":
        template = template.on_floor()
    if suffix in (".glb", ".fbx", *_USD):
        template = replace(template, body=with_arkit_names(template.body))
    # Unreal takes the skeleton's node for the root bone.
    root = {".glb": "skeleton"}.get(suffix, ROOT) if options.joint_names != "unreal" else _UNREAL_ROOT
    if suffix == ".glb":
        write_glb(path, template, animation=animation, root=root)
    elif suffix == ".fbx":
        write_fbx(path, template, animation=animation, root=root, blender=options.blender)
    elif suffix == ".vrm":
        write_vrm(path, template, meta=options.meta, joint_names=options.joint_names)
    elif suffix in _USD:
        write_usd(path, template, animation=animation)
    elif suffix == ".obj":
        # OBJ has no skeleton, so that the one pose is baked into the vertices.
        posed = template if animation is None else replace(template, vertices=template.pose(animation)[0])
        write_obj(path, posed)
    else:
        template.save(path)
    return path


def with_texture_size(template: Template, size: int | None) -> Template:
    """Return the template with pictures of at most so many texels a side; 0 leaves none, None changes nothing."""
    if size is None or template.texture is None:
        return template
    return replace(template, texture=template.texture.resized(size) if size else None)


def with_influences(template: Template, max_influences: int | None) -> Template:
    """Return the template with the strongest joints of each vertex alone, weights summing to 1; None changes nothing.

    Raises:
        InputError: fewer than 1 or more than 8 joints.
    """
    if max_influences is None:
        return template
    require_between("max_influences", max_influences, 1, MAX_INFLUENCES)
    return replace(template, weights=template.weights.pruned(max_influences))


@dataclass(frozen=True)
class PruningError:
    """What fewer joints a vertex do to a template in stress poses.

    Attributes:
        worst_mm: largest displacement of a vertex.
        pose: pose of `STRESS_POSES` in which it occurs.
        part: part that it belongs to.
        p99_mm: 99th percentile of the displacements of all vertices in all poses.
    """

    worst_mm: float
    pose: str
    part: str
    p99_mm: float


def pruning_error(template: Template, max_influences: int) -> PruningError:
    """Measure by how much a template with at most `max_influences` joints a vertex leaves its own stress poses.

    Raises:
        InputError: fewer than 1 or more than 8 joints.
    """
    poses = stress_poses(BodyParams.rest(betas=0, expressions=0))
    pruned = with_influences(template, max_influences)
    moved = 1000.0 * np.linalg.norm(pruned.pose(poses) - template.pose(poses), axis=2)
    # Vertices without a face show nothing.
    moved = moved[:, np.unique(template.faces)]
    pose, column = np.unravel_index(int(moved.argmax()), moved.shape)
    vertex = np.unique(template.faces)[column]
    return PruningError(
        worst_mm=float(moved[pose, column]),
        pose=list(STRESS_POSES)[pose],
        part=template.part_names[template.vertex_part[vertex]],
        p99_mm=float(np.percentile(moved, 99.0)),
    )
