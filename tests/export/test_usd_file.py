"""A template as USD, skinned by UsdSkel's own code."""

from __future__ import annotations

import errno
from dataclasses import replace

import numpy as np
import pytest

from smplxpp.core.errors import InputError
from smplxpp.export.usd import write_usd
from smplxpp.template.template import Template
from tests.export.templates import open_body_template, random_motion, random_template
from tests.full_disk import file_size_limit

pxr = pytest.importorskip("pxr")
from pxr import Usd, UsdGeom, UsdShade, UsdSkel  # noqa: E402


def baked(path, template: Template, frames: int) -> list[dict[str, np.ndarray]]:
    """Points of each part in each frame, after UsdSkel has skinned them and applied the blend shapes."""
    stage = Usd.Stage.Open(str(path))
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetDefaultPrim()))
    out = []
    for k in range(frames):
        meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
        out.append({prim.GetName(): np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(k)) for prim in meshes})
    return out


@pytest.mark.parametrize(
    ("make", "expressions"),
    [(random_template, 3), (lambda: random_template(expressions=0), 0), (open_body_template, 52)],
)
def test_usdskel_poses_it_as_we_do(tmp_path, make, expressions):
    template, motion = make(), random_motion(3, expressions=expressions)
    template = replace(template, body=replace(template.body, posedirs=None))
    write_usd(tmp_path / "a.usdc", template, animation=motion)
    ours = template.pose(motion)
    for k, parts in enumerate(baked(tmp_path / "a.usdc", template, len(motion))):
        for index, name in enumerate(template.part_names):
            rows = template.vertex_part == index
            if name in parts:
                np.testing.assert_allclose(parts[name], ours[k][rows], atol=2e-6)
    assert np.abs(ours[0] - template.vertices).max() > 0.05


def test_the_stage_says_what_it_holds(tmp_path):
    template = random_template()
    write_usd(tmp_path / "a.usda", template)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/template/skeleton"))
    topology = UsdSkel.Topology(skeleton.GetJointsAttr().Get())
    assert topology.Validate()[0]
    np.testing.assert_array_equal(topology.GetParentIndices(), template.body.parents)
    bind = np.array(skeleton.GetBindTransformsAttr().Get())
    np.testing.assert_allclose(bind[:, 3, :3], template.joints, atol=1e-12)
    body = UsdGeom.Mesh(stage.GetPrimAtPath("/template/body"))
    faces = np.array(body.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    np.testing.assert_array_equal(faces, template.faces[template.part_faces("body")])
    color = np.array(UsdGeom.PrimvarsAPI(body).GetPrimvar("displayColor").Get())
    rows = template.vertex_part == 0
    np.testing.assert_allclose((color < 0.2140), template.vertex_colors[rows] < 127.5)
    material, _ = UsdShade.MaterialBindingAPI(body.GetPrim()).ComputeBoundMaterial()
    assert material
    binding = UsdSkel.BindingAPI(body.GetPrim())
    assert list(binding.GetBlendShapesAttr().Get()) == list(template.body.expression_names)
    assert not stage.HasAuthoredTimeCodeRange()


def test_the_rate_is_the_motions_and_bad_ones_are_refused(tmp_path):
    template, motion = random_template(), random_motion(4, expressions=3)
    write_usd(tmp_path / "a.usdc", template, animation=replace(motion, fps=24.0))
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (24.0, 3.0)
    with pytest.raises(InputError, match="frames a second"):
        write_usd(tmp_path / "b.usdc", template, animation=replace(motion, fps=-1.0))
    with pytest.raises(InputError, match="usda"):
        write_usd(tmp_path / "b.fbx", template)
    assert not list(tmp_path.glob("b*"))


@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usdz"])
def test_a_full_disk_is_an_error_of_the_system_and_leaves_nothing(tmp_path, suffix):
    """It was a traceback of thirty lines out of USD's own code."""
    with file_size_limit(4000), pytest.raises(OSError) as caught:
        write_usd(tmp_path / f"a{suffix}", random_template())
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(tmp_path / f"a{suffix}"))
    assert list(tmp_path.iterdir()) == []
