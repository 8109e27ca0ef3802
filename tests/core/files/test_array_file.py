import io
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import array_names, read_array, read_arrays, write_arrays

KINDS = ["<f4", ">f8", "<i2", ">u4", "|b1", "<U7", "|S3", "<f2", "|i1"]


def npy(header: str, data: bytes = b"", version: int = 1) -> bytes:
    width = 2 if version == 1 else 4
    return b"\x93NUMPY" + bytes([version, 0]) + len(header).to_bytes(width, "little") + header.encode() + data


def zipped(path, **entries: bytes):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            archive.writestr(f"{name}.npy", data)
    return path


def stored_arrays() -> st.SearchStrategy[np.ndarray]:
    """Arrays of every kind; texts have characters alone, as others are refused."""
    texts = {"alphabet": st.characters(exclude_categories=["Cs"], exclude_characters="\0")}
    shapes = hnp.array_shapes(min_dims=0, min_side=0)
    kinds = st.sampled_from(KINDS).map(np.dtype)
    return kinds.flatmap(lambda kind: hnp.arrays(kind, shapes, elements=texts if kind.kind == "U" else None))


@given(stored_arrays(), st.booleans())
@pytest.mark.long
def test_what_numpy_writes_comes_back(tmp_path_factory, array, fortran):
    folder = tmp_path_factory.getbasetemp()
    array = np.asfortranarray(array) if fortran else array
    np.save(folder / "x.npy", array)
    np.savez_compressed(folder / "x.npz", first=array, second=np.arange(3))
    for back in (read_array(folder / "x.npy"), read_arrays(folder / "x.npz")["first"]):
        np.testing.assert_array_equal(back, array)
        assert back.dtype == array.dtype.newbyteorder("=") and back.flags.writeable
        assert back.flags.f_contiguous == array.flags.f_contiguous


@pytest.mark.parametrize("version", [1, 2, 3])
def test_headers_of_other_writers(tmp_path, version):
    data = np.arange(6, dtype="<i4")
    for header in (
        "{'descr': '<i4', 'fortran_order': False, 'shape': (3L, 2L), }\n",  # Python 2
        '{"shape": (3,2), "descr": "<i4", "fortran_order": False}',
        "{'shape': (3, 2), 'fortran_order': False, 'descr': '<i4'}",
    ):
        (tmp_path / "x.npy").write_bytes(npy(header, data.tobytes(), version))
        np.testing.assert_array_equal(read_array(tmp_path / "x.npy"), data.reshape(3, 2))


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 99999999999999999999), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 8), }",
        "{'descr': '|V0', 'fortran_order': False, 'shape': (8,), }",
        "{'descr': '<U0', 'fortran_order': False, 'shape': (99999999999,), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': [('a', '|O')], 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f3', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<c8', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<M8', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f8', 'fortran_order': 0, 'shape': (1,), }",
        "{'descr': '<f8', 'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "(" * 9000,
        "",
    ],
)
def test_headers_that_claim_what_cannot_be_are_refused(tmp_path, header):
    (tmp_path / "x.npy").write_bytes(npy(header, bytes(8)))
    with pytest.raises(InputError, match=r"x\.npy"):
        read_array(tmp_path / "x.npy")
    with pytest.raises(InputError, match=r"x\.npz"):
        read_arrays(zipped(tmp_path / "x.npz", a=npy(header, bytes(8))))


def test_lengths_must_agree_to_the_byte(tmp_path):
    np.save(tmp_path / "x.npy", np.arange(10))
    whole = (tmp_path / "x.npy").read_bytes()
    for data in (whole[:-1], whole + b"\0", whole[:9], b""):
        (tmp_path / "x.npy").write_bytes(data)
        with pytest.raises(InputError):
            read_array(tmp_path / "x.npy")


def test_a_stored_entry_shorter_than_its_header_says_is_not_repeated(tmp_path):
    """One byte under a right checksum, where the archive's directory and the header announce 8,000."""
    header = npy("{'descr': '|u1', 'fortran_order': False, 'shape': (8000,), }")
    zipped(tmp_path / "x.npz", a=header + b"\7")
    raw = (tmp_path / "x.npz").read_bytes()
    size, claimed = len(header) + 1, len(header) + 8000
    assert raw.count(size.to_bytes(4, "little")) >= 2  # of the entry's size, in both of its records
    (tmp_path / "x.npz").write_bytes(raw.replace(size.to_bytes(4, "little"), claimed.to_bytes(4, "little")))
    with pytest.raises(InputError, match=r"x\.npz"):
        read_arrays(tmp_path / "x.npz")


@pytest.mark.parametrize("point", [0x110000, 0xD800, 0xFFFFFFFF])
def test_texts_of_code_points_that_are_none_are_refused(tmp_path, point):
    text = np.array([65, point], dtype="<u4").tobytes()
    (tmp_path / "x.npy").write_bytes(npy("{'descr': '<U2', 'fortran_order': False, 'shape': (1,), }", text))
    with pytest.raises(InputError, match="code points"):
        read_array(tmp_path / "x.npy")


@pytest.mark.long
def test_an_archive_that_unpacks_to_thousands_of_times_its_size_is_refused(tmp_path):
    count = 700 << 20
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({count},), }}"
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("a.npy", "w", force_zip64=True) as stream:
            stream.write(npy(header))
            for _ in range(700):
                stream.write(bytes(1 << 20))
    with pytest.raises(InputError, match="unpack to"):
        read_arrays(tmp_path / "bomb.npz")
    assert array_names(tmp_path / "bomb.npz") == ["a"]


def test_damaged_archives_are_refused(tmp_path):
    write_arrays(tmp_path / "x.npz", {"a": np.arange(200.0), "b": np.arange(3)})
    whole = (tmp_path / "x.npz").read_bytes()
    at = whole.find(b"a.npy") + 40
    for data in (
        whole[:-30],
        whole[:at] + b"\xff" * 20 + whole[at + 20 :],
        b"PK\x05\x06" + bytes(18),
        b"no archive",
        b"",
    ):
        (tmp_path / "x.npz").write_bytes(data)
        with pytest.raises(InputError, match=r"x\.npz"):
            read_arrays(tmp_path / "x.npz", remedy="build it again")


def test_two_arrays_of_one_name_are_refused(tmp_path):
    stream = io.BytesIO()
    np.save(stream, np.arange(3))
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("a.npy", stream.getvalue())
        archive.writestr("a.npy", stream.getvalue())
    with pytest.raises(InputError, match="2 arrays of 1 names"):
        read_arrays(tmp_path / "x.npz")


def test_only_the_keys_asked_for_are_read(tmp_path):
    good = io.BytesIO()
    np.save(good, np.arange(3))
    path = zipped(tmp_path / "x.npz", good=good.getvalue(), bad=npy("{}"))
    assert list(read_arrays(path, keys=["good", "none"])) == ["good"]
