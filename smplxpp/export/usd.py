"""A template, with its skin, expressions and motion, as USD (UsdSkel)."""

from __future__ import annotations

import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from smplxpp.core import DEFAULT_FPS, BodyParams, GeometryWarning, require_positive
from smplxpp.core.colors import decode_srgb
from smplxpp.export.gltf_animation import joint_motion
from smplxpp.export.gltf_skin import rest_offsets
from smplxpp.export.usd_stage import open_usd, usd_modules
from smplxpp.template.template import BODY_PART, Template
from smplxpp.template.texture import part_surface, picture_files

_ROOT = "template"


def write_usd(path: str | Path, template: Template, *, animation: BodyParams | None = None) -> None:
    """Write the template as a `SkelRoot`, whole or not at all.

    A mesh a part with all its skin weights, normals, linear colours (`displayColor`) and a material of its label, in
    the template's texture where it has one, whose pictures lie beside the file, or within a .usdz; one skeleton; the
    expressions as blend shapes of the body; the motion as a `SkelAnimation`, one time code a frame. UsdSkel's skinning
    then gives what `template.pose(animation)` gives, to float32, but for pose correctives. Metres, +Y up.

    Args:
        path: .usdc, .usda, .usd or .usdz.
        animation: T frames, played at their `fps` or `DEFAULT_FPS`.

    Raises:
        InputError: another suffix, or an animation that the template cannot play.
        MissingExtraError: no usd-core.

    Warns:
        GeometryWarning: an animation of a template with pose correctives, which UsdSkel has no place for.
    """
    pxr = usd_modules("a template as USD")
    if animation is not None and template.body.posedirs is not None:
        warnings.warn("animation: the pose correctives of the template are left out", GeometryWarning, stacklevel=2)
    fps = None if animation is None else animation.fps or DEFAULT_FPS
    if fps is not None:
        require_positive("frames a second of the animation", fps)
    files = {} if template.texture is None else picture_files(template.texture, Path(path).stem)
    # The stage names the files by their places beside it.
    named = (
        tuple(f"./{name}" for name in files if name.endswith(".jpg")),
        tuple(f"./{name}" for name in files if name.endswith(".png")),
    )
    with open_usd(path, default=_ROOT, fps=fps, beside=files) as stage:
        pxr.UsdSkel.Root.Define(stage, f"/{_ROOT}")
        joints = _add_skeleton(pxr, stage, template)
        shapes = _add_parts(pxr, stage, template, named)
        if animation is not None:
            _add_motion(pxr, stage, template, animation, (joints, shapes))
            stage.SetEndTimeCode(len(animation) - 1)


def _add_skeleton(pxr: SimpleNamespace, stage: Any, template: Template) -> list[str]:
    """Add the skeleton at rest; return the paths of its joints."""
    names = [_identifier(name) for name in template.body.joint_names]
    paths: list[str] = []
    for name, parent in zip(names, template.body.parents, strict=True):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    skeleton = pxr.UsdSkel.Skeleton.Define(stage, f"/{_ROOT}/skeleton")
    skeleton.CreateJointsAttr(paths)
    skeleton.CreateBindTransformsAttr(_translations(pxr, template.joints))
    skeleton.CreateRestTransformsAttr(_translations(pxr, rest_offsets(template)))
    return paths


def _add_parts(
    pxr: SimpleNamespace, stage: Any, template: Template, pictures: tuple[tuple[str, ...], tuple[str, ...]]
) -> list[str]:
    """Add a mesh a part, with the files of its colours and normals; return the names of the body's blend shapes."""
    Vt, shapes = pxr.Vt, []
    normals = template.mesh.vertex_normals.astype(np.float32)
    influences = template.weights.joint_indices.shape[1]
    for index, name in enumerate(template.part_names):
        surface = part_surface(template, index)
        if surface is None:
            continue
        rows, faces = surface.rows, surface.faces
        points = np.ascontiguousarray(template.vertices[rows], np.float32)
        mesh = pxr.UsdGeom.Mesh.Define(stage, f"/{_ROOT}/{_identifier(name)}")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
        mesh.CreateSubdivisionSchemeAttr("none")
        # Garments are open surfaces, whose inside shows at hems; of the body only the outside shows.
        mesh.CreateDoubleSidedAttr(name != BODY_PART)
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals[rows]))
        mesh.SetNormalsInterpolation("vertex")
        colors = mesh.CreateDisplayColorPrimvar("vertex")
        colors.Set(Vt.Vec3fArray.FromNumpy(_linear(template.vertex_colors[rows])))
        binding = pxr.UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        binding.CreateSkeletonRel().SetTargets([f"/{_ROOT}/skeleton"])
        binding.CreateGeomBindTransformAttr(pxr.Gf.Matrix4d(1.0))
        joints = template.weights.joint_indices[rows].astype(np.int32).ravel()
        weights = template.weights.joint_weights[rows].astype(np.float32).ravel()
        binding.CreateJointIndicesPrimvar(False, influences).Set(Vt.IntArray.FromNumpy(joints))
        binding.CreateJointWeightsPrimvar(False, influences).Set(Vt.FloatArray.FromNumpy(weights))
        if surface.uv is not None:
            # USD's pictures begin at the lower left corner.
            uv = np.ascontiguousarray(surface.uv * [1, -1] + [0, 1], np.float32)
            places = pxr.UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", pxr.Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
            places.Set(Vt.Vec2fArray.FromNumpy(uv))
        _add_material(pxr, mesh, *_material_of(template, index, rows, pictures))
        if name == BODY_PART:
            shapes = _add_expressions(pxr, stage, template, mesh, rows)
    return shapes


def _add_expressions(pxr: SimpleNamespace, stage: Any, template: Template, mesh: Any, used: np.ndarray) -> list[str]:
    names, targets = [], []
    # A vertex that an expression of one unit moves by less, in metres, is left out of that blend shape.
    still = 1e-6
    for k, expression in enumerate(template.body.expression_names):
        offsets = np.ascontiguousarray(template.body.exprdirs[used, :, k], np.float32)
        # Blend shapes are sparse: only vertices that an expression moves are stored.
        rows = np.flatnonzero(np.square(offsets).sum(axis=1) > still**2)
        shape = pxr.UsdSkel.BlendShape.Define(stage, mesh.GetPath().AppendChild(_identifier(expression)))
        shape.CreateOffsetsAttr(pxr.Vt.Vec3fArray.FromNumpy(offsets[rows]))
        shape.CreatePointIndicesAttr(pxr.Vt.IntArray.FromNumpy(rows.astype(np.int32)))
        names.append(_identifier(expression))
        targets.append(shape.GetPath())
    if names:
        binding = pxr.UsdSkel.BindingAPI(mesh.GetPrim())
        binding.CreateBlendShapesAttr(names)
        binding.CreateBlendShapeTargetsRel().SetTargets(targets)
    return names


def _material_of(
    template: Template, part: int, rows: np.ndarray, pictures: tuple[tuple[str, ...], tuple[str, ...]]
) -> tuple[str, str | None, str | None]:
    """Return the name of a part's material, its commonest label's, and its files of colours and normals."""
    name = template.labels[int(np.bincount(template.vertex_labels[rows]).argmax())].name
    colors, reliefs = pictures
    k = 0 if template.texture is None else int(template.texture.picture[part])
    return name, colors[k] if colors else None, reliefs[k] if reliefs else None


def _add_material(pxr: SimpleNamespace, mesh: Any, name: str, color: str | None, relief: str | None) -> None:
    """Add a preview surface in the colours of a picture, or of the vertices where there is none."""
    stage, path = mesh.GetPrim().GetStage(), mesh.GetPath().AppendChild(f"{_identifier(name)}_material")
    types = pxr.Sdf.ValueTypeNames
    material = pxr.UsdShade.Material.Define(stage, path)
    surface = pxr.UsdShade.Shader.Define(stage, path.AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", types.Float).Set(0.9)
    # Vertices' colours are read from their primvar `displayColor`, places in pictures from `st`.
    varname, kind = ("displayColor", "float3") if color is None else ("st", "float2")
    reader = pxr.UsdShade.Shader.Define(stage, path.AppendChild("reader"))
    reader.CreateIdAttr(f"UsdPrimvarReader_{kind}")
    reader.CreateInput("varname", types.String).Set(varname)
    place = reader.CreateOutput("result", types.Float3 if color is None else types.Float2)

    def picture(kind: str, file: str, space: str) -> Any:
        shader = pxr.UsdShade.Shader.Define(stage, path.AppendChild(kind))
        shader.CreateIdAttr("UsdUVTexture")
        shader.CreateInput("file", types.Asset).Set(pxr.Sdf.AssetPath(file))
        shader.CreateInput("sourceColorSpace", types.Token).Set(space)
        shader.CreateInput("wrapS", types.Token).Set("clamp")
        shader.CreateInput("wrapT", types.Token).Set("clamp")
        shader.CreateInput("st", types.Float2).ConnectToSource(place)
        return shader

    seen = place if color is None else picture("color", color, "sRGB").CreateOutput("rgb", types.Float3)
    surface.CreateInput("diffuseColor", types.Color3f).ConnectToSource(seen)
    if relief is not None:
        shader = picture("normals", relief, "raw")
        # From bytes in [0, 1] to directions in [-1, 1].
        shader.CreateInput("scale", types.Float4).Set(pxr.Gf.Vec4f(2, 2, 2, 1))
        shader.CreateInput("bias", types.Float4).Set(pxr.Gf.Vec4f(-1, -1, -1, 0))
        surface.CreateInput("normal", types.Normal3f).ConnectToSource(shader.CreateOutput("rgb", types.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    pxr.UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _add_motion(
    pxr: SimpleNamespace, stage: Any, template: Template, params: BodyParams, named: tuple[list[str], list[str]]
) -> None:
    joints, shapes = named
    rotations, translations = joint_motion(template, params)
    # Quaternions as (x, y, z, w) in float32, the memory layout of Vt.QuatfArray.
    xyzw = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat().astype(np.float32)
    xyzw = xyzw.reshape(*rotations.shape[:2], 4)
    weights = np.zeros((len(params), len(shapes)), np.float32)
    given = min(params.expression.shape[1], len(shapes))
    weights[:, :given] = params.expression[:, :given]
    motion = pxr.UsdSkel.Animation.Define(stage, f"/{_ROOT}/motion")
    motion.CreateJointsAttr(joints)
    motion.CreateScalesAttr(pxr.Vt.Vec3hArray.FromNumpy(np.ones((len(joints), 3), np.float16)))
    if shapes:
        motion.CreateBlendShapesAttr(shapes)
    for k in range(len(params)):
        motion.CreateTranslationsAttr().Set(pxr.Vt.Vec3fArray.FromNumpy(translations[k].astype(np.float32)), k)
        motion.CreateRotationsAttr().Set(pxr.Vt.QuatfArray.FromNumpy(np.ascontiguousarray(xyzw[k])), k)
        if shapes:
            motion.CreateBlendShapeWeightsAttr().Set(pxr.Vt.FloatArray.FromNumpy(weights[k]), k)
    skeleton = pxr.UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath(f"/{_ROOT}/skeleton"))
    skeleton.CreateAnimationSourceRel().SetTargets([motion.GetPath()])


def _translations(pxr: SimpleNamespace, offsets: np.ndarray) -> Any:
    return pxr.Vt.Matrix4dArray([pxr.Gf.Matrix4d(1.0).SetTranslate(tuple(map(float, row))) for row in offsets])


def _linear(colors: np.ndarray) -> np.ndarray:
    """Convert sRGB bytes to linear light, float32."""
    return decode_srgb(colors / 255.0).astype(np.float32)


def _identifier(name: str) -> str:
    """A name that paths of USD can have."""
    kept = "".join(letter if letter.isascii() and (letter.isalnum() or letter == "_") else "_" for letter in name)
    return kept if kept and not kept[0].isdigit() else f"_{kept}"
