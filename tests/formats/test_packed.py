"""SPZ and SOG: what other programs read is what was written, to the steps that these formats have."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from avatar.formats import Splats, write_splat_sog, write_splat_spz
from avatar.formats.packed_splats import _palette
from smplxpp.core.errors import InputError
from tests.formats.foreign import gsply_splats


def person(count: int = 400, degree: int = 1, seed: int = 0) -> Splats:
    """Splats of a person's sizes."""
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.uniform((-0.8, 0.0, -0.2), (0.8, 1.8, 0.2), size=(count, 3)),
        normals=np.zeros((count, 3)),
        f_dc=rng.uniform(-1.7, 1.7, size=(count, 3)),
        f_rest=rng.normal(scale=0.1, size=(count, (degree + 1) ** 2 - 1, 3)),
        opacity_logits=rng.normal(2.0, 3.0, size=count),
        log_scales=rng.uniform(np.log(1e-4), np.log(2e-2), size=(count, 3)),
        quats=rng.normal(size=(count, 4)),
    )


def angles(a: Splats, b: Splats) -> np.ndarray:
    """Degrees between rotations."""
    dots = np.abs(np.sum(a.unit_quats.astype(float) * b.unit_quats, axis=1))
    return np.degrees(2 * np.arccos(np.clip(dots, -1, 1)))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsply_reads_an_spz(tmp_path, degree):
    pytest.importorskip("gsply")
    splats = person(300, degree)
    write_splat_spz(tmp_path / "a.spz", splats)
    theirs = gsply_splats(tmp_path / "a.spz")
    np.testing.assert_allclose(theirs.means, splats.means, atol=0.5 / 65536 + 1e-7)
    np.testing.assert_allclose(theirs.log_scales, splats.log_scales, atol=0.5 / 16 + 1e-6)
    np.testing.assert_allclose(theirs.f_dc, splats.f_dc, atol=0.5 / (0.15 * 255) + 1e-6)
    np.testing.assert_allclose(theirs.opacities, splats.opacities, atol=0.5 / 255 + 1e-5)
    np.testing.assert_allclose(theirs.f_rest, splats.f_rest, atol=0.5 / 128 + 1e-6)
    assert theirs.degree == degree and angles(theirs, splats).max() < 0.3


def test_gsply_writes_the_same_spz(tmp_path):
    """The numbers packed by another writer, so that an agreement of its reader with our mistakes cannot pass."""
    gsply = pytest.importorskip("gsply")
    splats = person(50, 1)
    write_splat_spz(tmp_path / "a.spz", splats)
    columns = (splats.means, splats.log_scales, splats.unit_quats, splats.opacity_logits, splats.f_dc, splats.f_rest)
    names = ("means", "scales", "quats", "opacities", "sh0", "shN")
    data = gsply.GSData.from_arrays(**dict(zip(names, columns, strict=True)), format="ply")
    gsply.write_spz(tmp_path / "b.spz", data, fractional_bits=16)
    ours, theirs = (gsply_splats(tmp_path / name) for name in ("a.spz", "b.spz"))
    np.testing.assert_array_equal(ours.quats, theirs.quats)
    np.testing.assert_array_equal(ours.means, theirs.means)
    np.testing.assert_array_equal(ours.f_rest, theirs.f_rest)


def test_an_spz_of_far_things_is_coarser_and_none_reaches_the_moon(tmp_path):
    gsply = pytest.importorskip("gsply")
    splats = person(20)
    far = replace(splats, means=splats.means + np.array([3000.0, 0, 0], np.float32))
    write_splat_spz(tmp_path / "a.spz", far)
    np.testing.assert_allclose(gsply.read_spz(tmp_path / "a.spz").means, far.means, atol=1 / 2048)
    with pytest.raises(InputError, match="8,000 km"):
        write_splat_spz(tmp_path / "b.spz", replace(splats, means=splats.means + np.float32(4e8)))
    assert not (tmp_path / "b.spz").exists()


def sog_by_its_specification(path) -> dict[str, np.ndarray]:
    """Decode a SOG as PlayCanvas's specification says, with Pillow."""
    with zipfile.ZipFile(path) as package:
        meta = json.loads(package.read("meta.json"))

        def picture(name: str) -> np.ndarray:
            return np.asarray(Image.open(io.BytesIO(package.read(name))).convert("RGBA")).astype(np.int64)

        def rows(name: str) -> np.ndarray:
            return picture(name).reshape(-1, 4)[: meta["count"]]

        low, high = (rows(name) for name in meta["means"]["files"])
        share = (low[:, :3] + 256 * high[:, :3]) / 65535
        ends = [np.array(meta["means"][name]) for name in ("mins", "maxs")]
        flat = ends[0] + share * (ends[1] - ends[0])
        sh0, turn = rows(meta["sh0"]["files"][0]), rows(meta["quats"]["files"][0])
        small = (turn[:, :3] / 255 - 0.5) * 2 / np.sqrt(2)
        quats = np.array(
            [
                np.insert(row, tag - 252, np.sqrt(max(0, 1 - row @ row)))
                for row, tag in zip(small, turn[:, 3], strict=True)
            ]
        )
        out = {
            "means": np.sign(flat) * np.expm1(np.abs(flat)),
            "quats": quats,
            "log_scales": np.array(meta["scales"]["codebook"])[rows(meta["scales"]["files"][0])[:, :3]],
            "f_dc": np.array(meta["sh0"]["codebook"])[sh0[:, :3]],
            "opacities": sh0[:, 3] / 255,
        }
        if "shN" in meta:
            table, labels = picture(meta["shN"]["files"][0]), rows(meta["shN"]["files"][1])
            count = (meta["shN"]["bands"] + 1) ** 2 - 1
            entries = table[:, :, :3].reshape(table.shape[0], 64, count, 3).reshape(-1, count, 3)
            out["f_rest"] = np.array(meta["shN"]["codebook"])[entries[labels[:, 0] + 256 * labels[:, 1]]]
        return out


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_sog_says_what_was_written(tmp_path, degree):
    splats = person(700, degree)
    write_splat_sog(tmp_path / "a.sog", splats)
    theirs = sog_by_its_specification(tmp_path / "a.sog")
    # In another order: the nearest place is the same splat.
    order = np.array([np.argmin(np.square(splats.means - place).sum(axis=1)) for place in theirs["means"]])
    assert sorted(order) == list(range(700))
    np.testing.assert_allclose(theirs["means"], splats.means[order], atol=5e-5)
    for name, most, usual in (("log_scales", 0.03, 0.006), ("f_dc", 0.02, 0.005), ("f_rest", 0.02, 0.002)):
        if name in theirs and degree + (name != "f_rest"):
            difference = np.abs(theirs[name] - getattr(splats, name)[order])
            assert difference.max() < most and difference.mean() < usual, name
    np.testing.assert_allclose(theirs["opacities"], splats.opacities[order], atol=0.5 / 255 + 1e-9)
    dots = np.abs(np.sum(theirs["quats"] * splats.unit_quats[order], axis=1))
    assert np.degrees(2 * np.arccos(np.minimum(dots, 1.0))).max() < 1.0


def test_gsply_reads_a_sog(tmp_path):
    pytest.importorskip("gsply")
    pytest.importorskip("imagecodecs")
    write_splat_sog(tmp_path / "a.sog", person(90, 2))
    ours, theirs = sog_by_its_specification(tmp_path / "a.sog"), gsply_splats(tmp_path / "a.sog")
    for name in ("means", "f_dc", "f_rest", "log_scales", "opacities", "quats"):
        np.testing.assert_allclose(getattr(theirs, name), ours[name], atol=2e-5, err_msg=name)


@pytest.mark.parametrize("write", [write_splat_spz, write_splat_sog])
def test_packed_files_repeat_and_take_few_splats(tmp_path, write):
    for count in (0, 1, 5):
        names = [tmp_path / f"{count}{name}.{write.__name__[-3:]}" for name in "ab"]
        for path in names:
            write(path, person(count))
        assert names[0].read_bytes() == names[1].read_bytes()
    if write is write_splat_sog:
        assert len(sog_by_its_specification(tmp_path / "1a.sog")["means"]) == 1


def test_a_palette_too_small_takes_what_is_near(monkeypatch):
    monkeypatch.setattr("avatar.formats.packed_splats._MAX_PALETTE", 16)
    rng = np.random.default_rng(0)
    kinds = rng.normal(size=(4, 9))
    sets = (kinds[rng.integers(0, 4, 500)] + rng.normal(scale=1e-3, size=(500, 9))).astype(np.float32)
    palette, labels = _palette(sets)
    assert len(palette) == 16 and np.abs(palette[labels] - sets).max() < 0.01
