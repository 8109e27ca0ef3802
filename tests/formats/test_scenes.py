"""Splats in scenes: glTF by pygltflib against the extension's schema, USD by usd-core."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pygltflib
import pytest

from avatar.formats import write_splat_glb
from avatar.formats.splat_scenes import write_splat_usd
from smplxpp.core.errors import InputError, MissingExtraError
from tests.export.glb_reader import GlbReader
from tests.export.test_glb_validator import validate
from tests.formats.foreign import pygltflib_splats, usd_splats
from tests.formats.test_packed import angles, person

KHR = "KHR_gaussian_splatting"


def assert_near(theirs, splats) -> None:
    for name in ("means", "f_dc", "f_rest"):
        np.testing.assert_array_equal(getattr(theirs, name), getattr(splats, name), err_msg=name)
    np.testing.assert_allclose(theirs.log_scales, splats.log_scales, atol=1e-6)
    np.testing.assert_allclose(theirs.opacities, splats.opacities, atol=1e-6)
    assert angles(theirs, splats).max() < 0.06  # as near as arccos of float32 sees


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_pygltflib_reads_the_splats(tmp_path, degree):
    splats = person(40, degree)
    write_splat_glb(tmp_path / "a.glb", splats)
    assert_near(pygltflib_splats(tmp_path / "a.glb"), splats)


def test_the_file_is_what_the_extension_asks_for(tmp_path):
    """The release candidate's table of attributes and its schema, written down here."""
    write_splat_glb(tmp_path / "a.glb", person(40, 1))
    reader = GlbReader(tmp_path / "a.glb")
    (primitive,) = reader.json["meshes"][0]["primitives"]
    assert primitive["mode"] == 0 and reader.json["extensionsUsed"] == [KHR] and "indices" not in primitive
    about = primitive["extensions"][KHR]
    assert {"kernel", "colorSpace"} <= set(about) <= {"kernel", "colorSpace", "projection", "sortingMethod"}
    assert (about["kernel"], about["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    types = {"POSITION": "VEC3", "COLOR_0": "VEC4", f"{KHR}:ROTATION": "VEC4", f"{KHR}:SCALE": "VEC3"}
    types |= {f"{KHR}:OPACITY": "SCALAR", f"{KHR}:SH_DEGREE_0_COEF_0": "VEC3"}
    types |= {f"{KHR}:SH_DEGREE_1_COEF_{k}": "VEC3" for k in range(3)}
    accessors = {name: reader.json["accessors"][index] for name, index in primitive["attributes"].items()}
    assert {name: accessor["type"] for name, accessor in accessors.items()} == types
    for name, accessor in accessors.items():
        assert accessor["componentType"] == (pygltflib.UNSIGNED_SHORT if name == "COLOR_0" else pygltflib.FLOAT)
    at = primitive["attributes"]
    turns = reader.array(at[f"{KHR}:ROTATION"])
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1.0, atol=1e-6)
    assert (reader.array(at[f"{KHR}:SCALE"]) > 0).all()
    opacity = reader.array(at[f"{KHR}:OPACITY"])
    assert ((opacity >= 0) & (opacity <= 1)).all()
    # COLOR_0 as the extension's note says: 0.5 + 0.282095 of the coefficient, clamped, sRGB to linear.
    srgb = np.clip(0.5 + 0.282095 * reader.array(at[f"{KHR}:SH_DEGREE_0_COEF_0"]).astype(float), 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(reader.array(at["COLOR_0"])[:, :3], linear, atol=2e-5)
    np.testing.assert_allclose(reader.array(at["COLOR_0"])[:, 3], opacity[:, 0], atol=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_khronos_has_no_remark_but_on_the_extension(tmp_path, degree):
    """It does not know the extension, and takes names of its attributes for wrong ones; these remarks and no others."""
    write_splat_glb(tmp_path / "a.glb", person(40, degree))
    issues = validate(tmp_path / "a.glb")["issues"]
    coefficients = [f"SH_DEGREE_{d}_COEF_{k}" for d in range(degree + 1) for k in range(2 * d + 1)]
    attributes = [f"{KHR}:{name}" for name in ("ROTATION", "SCALE", "OPACITY", *coefficients)]
    at = "/meshes/0/primitives/0/attributes/"
    expected = [("MESH_PRIMITIVE_INVALID_ATTRIBUTE", at + name) for name in attributes]
    expected.append(("UNSUPPORTED_EXTENSION", "/extensionsUsed/0"))
    assert sorted((one["code"], one["pointer"]) for one in issues["messages"]) == sorted(expected)
    assert not issues["truncated"]


def test_khronos_sees_damaged_splats(tmp_path):
    path = tmp_path / "a.glb"
    write_splat_glb(path, person(40, 1))
    path.write_bytes(path.read_bytes().replace(b'"count":40', b'"count":99'))
    codes = {message["code"] for message in validate(path)["issues"]["messages"]}
    assert "ACCESSOR_TOO_LONG" in codes


def test_gltf_cannot_say_no_splats(tmp_path):
    with pytest.raises(InputError, match="at least one"):
        write_splat_glb(tmp_path / "a.glb", person(0))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_usd_core_reads_the_splats(tmp_path, suffix):
    pytest.importorskip("pxr")
    splats = person(40, 2)
    path = tmp_path / f"a{suffix}"
    write_splat_usd(path, [splats])
    assert_near(usd_splats(path), splats)
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    low, high = np.array(stage.GetDefaultPrim().GetAttribute("extent").Get())
    assert (low < splats.means.min(axis=0)).all() and (high > splats.means.max(axis=0)).all()
    assert not stage.HasAuthoredTimeCodeRange()


def test_a_usd_moves(tmp_path):
    pytest.importorskip("pxr")
    first = person(30)
    frames = [replace(first, means=first.means + np.float32(0.1 * k)) for k in range(3)]
    write_splat_usd(tmp_path / "a.usdc", iter(frames), fps=25.0)
    for k, splats in enumerate(frames):
        assert_near(usd_splats(tmp_path / "a.usdc", k), splats)
    from pxr import Usd

    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 2, 25)


def test_what_usd_cannot_hold_is_refused(tmp_path):
    pytest.importorskip("pxr")
    for frames, suffix, word in (
        ([person(3), person(4)], ".usda", "frame 1"),
        ([], ".usda", "at least one"),
        ([person(3)], ".obj", "usdc"),
    ):
        with pytest.raises(InputError, match=word):
            write_splat_usd(tmp_path / f"a{suffix}", frames, fps=10.0)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_usd_core_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr.Gf", None)
    with pytest.raises(MissingExtraError, match=r"extra usd"):
        write_splat_usd(tmp_path / "a.usda", [person(2)])
