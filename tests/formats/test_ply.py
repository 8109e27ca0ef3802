"""Splats in the layout of 3D Gaussian Splatting."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from avatar.formats import Splats, read_splat_ply, write_splat_ply
from smplxpp.core.errors import InputError


def random_splats(count: int = 7, degree: int = 1) -> Splats:
    rng = np.random.default_rng(count + degree)

    def normal(*shape: int) -> np.ndarray:
        return rng.normal(size=(count, *shape)).astype(np.float32)

    return Splats(
        means=normal(3),
        normals=normal(3),
        f_dc=normal(3),
        f_rest=normal((degree + 1) ** 2 - 1, 3),
        opacity_logits=normal(),
        log_scales=normal(3),
        quats=normal(4),
    )


def assert_same(a: Splats, b: Splats) -> None:
    for f in fields(Splats):
        np.testing.assert_array_equal(getattr(a, f.name), getattr(b, f.name), err_msg=f.name)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 20])
def test_round_trip_is_exact(tmp_path, degree, count):
    splats = random_splats(count, degree)
    write_splat_ply(tmp_path / "a.ply", splats)
    assert_same(read_splat_ply(tmp_path / "a.ply"), splats)


def test_the_bytes_of_a_small_file(tmp_path):
    """The layout written down by hand, so that a change of it cannot pass unseen."""
    splats = random_splats(2, 1)
    write_splat_ply(tmp_path / "a.ply", splats)
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2".split() + [f"f_rest_{k}" for k in range(9)]
    names += "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    data = (tmp_path / "a.ply").read_bytes()
    assert data[: len(header)].decode() == header
    table = np.frombuffer(data[len(header) :], "<f4").reshape(2, -1)
    # Red's three coefficients come first.
    np.testing.assert_array_equal(table[:, 9:12], splats.f_rest[:, :, 0])
    np.testing.assert_array_equal(table[:, 15:18], splats.f_rest[:, :, 2])
    np.testing.assert_array_equal(table[:, -4:], splats.quats)


def test_trimesh_reads_the_same_numbers(tmp_path):
    splats = random_splats(5, 2)
    write_splat_ply(tmp_path / "a.ply", splats)
    data = trimesh.load(tmp_path / "a.ply").metadata["_ply_raw"]["vertex"]["data"]
    for name, values in (("y", splats.means[:, 1]), ("opacity", splats.opacity_logits), ("rot_0", splats.quats[:, 0])):
        np.testing.assert_array_equal(data[name].ravel(), values)
    np.testing.assert_array_equal(data["f_rest_9"].ravel(), splats.f_rest[:, 1, 1])


def test_gsply_reads_the_same_splats(tmp_path):
    gsply = pytest.importorskip("gsply")
    splats = random_splats(50, 3)
    write_splat_ply(tmp_path / "a.ply", splats)
    theirs = gsply.plyread(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(theirs.means, splats.means)
    np.testing.assert_array_equal(theirs.quats, splats.quats)
    np.testing.assert_array_equal(theirs.scales, splats.log_scales)
    np.testing.assert_array_equal(np.ravel(theirs.opacities), splats.opacity_logits)
    np.testing.assert_array_equal(theirs.sh0, splats.f_dc)
    gsply.plywrite(
        str(tmp_path / "b.ply"), theirs.means, theirs.scales, theirs.quats, theirs.opacities, theirs.sh0, theirs.shN
    )
    assert_same(read_splat_ply(tmp_path / "b.ply"), replace(splats, normals=np.zeros_like(splats.normals)))


@pytest.mark.parametrize(("order", "word"), [("<", "little"), (">", "big")])
def test_any_order_of_properties_and_any_type(tmp_path, order, word):
    splats = random_splats(4, 0)
    values = {f"f_dc_{k}": splats.f_dc[:, k] for k in (2, 0, 1)} | {"opacity": splats.opacity_logits}
    values |= {f"rot_{k}": splats.quats[:, k] for k in range(4)} | {"label": np.array([1, 2, 3, 250])}
    values |= dict(zip("zyx", splats.means[:, ::-1].T, strict=True))
    values |= {f"scale_{k}": splats.log_scales[:, k] for k in range(3)}
    kinds = {name: "f8" if k % 2 else "f4" for k, name in enumerate(values)} | {"label": "u1"}
    words = {"f4": "float32", "f8": "double", "u1": "uchar"}
    table = np.zeros(4, np.dtype([(name, order + kind) for name, kind in kinds.items()]))
    for name, column in values.items():
        table[name] = column
    header = f"ply\r\ncomment two elements\r\nformat binary_{word}_endian 1.0\r\nobj_info by hand\r\n"
    header += "element camera 3\r\nproperty short a\r\nproperty double b\r\nelement vertex 4\r\n"
    header += "".join(f"property {words[kind]} {name}\r\n" for name, kind in kinds.items())
    header += "element face 9\r\nproperty list uchar int vertex_indices\r\nend_header\r\n"
    path = tmp_path / "other.ply"
    path.write_bytes(header.encode() + bytes(30) + table.tobytes() + b"whatever")
    assert_same(read_splat_ply(path), replace(splats, normals=np.zeros((4, 3))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": np.full((7, 3), np.nan)}, "means.*first in splat 0"),
        ({"quats": np.zeros((7, 4))}, "quats"),
        ({"f_rest": np.zeros((7, 4, 3))}, "f_rest"),
        ({"f_dc": np.zeros((6, 3))}, "f_dc"),
        ({"log_scales": np.full((7, 3), 1e300)}, "log_scales"),
    ],
)
@pytest.mark.filterwarnings("ignore:overflow")
def test_splats_that_make_no_sense_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        replace(random_splats(), **change)


def test_damaged_files_are_refused(tmp_path):
    path = tmp_path / "a.ply"
    with pytest.raises(InputError, match="existing file"):
        read_splat_ply(path)
    write_splat_ply(path, random_splats())
    good = path.read_bytes()
    cases = {
        "starts with": b"PK\x03\x04" + good,
        "truncated": good[:-1],
        "no end of it": good[:40],
        "text PLY": good.replace(b"binary_little_endian", b"ascii"),
        "no opacity": good.replace(b" opacity", b" opaqueness"),
        "8 of f_rest": good.replace(b"property float f_rest_8", b"property float gone__8"),
        "property twice": good.replace(b"f_rest_8", b"f_rest_7"),
        "no element 'vertex'": good.replace(b"element vertex", b"element vortex"),
        "the line 'element vertex -7'": good.replace(b"vertex 7", b"vertex -7"),
        "lists in element": good.replace(b"property float x", b"property list uchar float x"),
        "letters outside": good.replace(b"opacity", b"opacit\xff"),
        "no format": good.replace(b"format binary_little_endian 1.0\n", b""),
        "finite float32": good[:-4] + np.float32(np.nan).tobytes(),
    }
    for message, data in cases.items():
        path.write_bytes(data)
        with pytest.raises(InputError, match=message):
            read_splat_ply(path)


@given(cut=st.integers(0, 2000), flip=st.integers(0, 400), value=st.integers(0, 255))
def test_any_damage_gives_splats_or_an_input_error(tmp_path_factory, cut, flip, value):
    path = tmp_path_factory.getbasetemp() / "damaged.ply"
    write_splat_ply(path, random_splats())
    data = bytearray(path.read_bytes())
    data[flip] = value
    path.write_bytes(data[: len(data) - cut])
    try:
        assert isinstance(read_splat_ply(path), Splats)
    except InputError:
        pass


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.ply"
    write_splat_ply(path, random_splats())
    before = path.read_bytes()
    with pytest.raises(AttributeError):
        write_splat_ply(path, None)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1
