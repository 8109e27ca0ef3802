import os
import pickle
import struct
import sys
import types

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st

from smplxpp.core.errors import InputError
from smplxpp.core.files.safe_pickle import InertObject, dense_array, safe_load, safe_npz


class Call:
    """Pickles as a call of `function(*arguments)`."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def write_pickle(path, value, protocol=2):
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", range(6))
def test_arrays_and_containers_come_back(tmp_path, protocol):
    value = {
        "array": np.arange(6.0).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "names": np.array(["a", "bc"]),
        "scalar": np.float32(2.5),
        "objects": np.array([{"a": 1}, [1, 2]], dtype=object),
        "mixed": [1, 2.5, "x", b"\xff\x00", None, (True, {1, 2}), frozenset({3}), 1 + 2j],
    }
    back = safe_load(write_pickle(tmp_path / "x.pkl", value, protocol))
    for name in ("array", "fortran", "names", "objects"):
        np.testing.assert_array_equal(back[name], value[name])
    assert back["scalar"] == value["scalar"] and back["mixed"] == value["mixed"]


@pytest.mark.parametrize("protocol", [0, 2, 5])
@pytest.mark.parametrize(
    ("function", "name"), [(os.system, "system"), (eval, "eval"), (getattr, "getattr"), (np.load, "load")]
)
def test_a_pickle_that_calls_something_is_refused_and_not_run(tmp_path, protocol, function, name):
    marker = tmp_path / "ran"
    argument = f"touch {marker}" if function is os.system else f"open({str(marker)!r}, 'w')"
    path = write_pickle(tmp_path / "bad.pkl", {"v_template": Call(function, argument)}, protocol)
    with pytest.raises(InputError, match=rf"\.{name}: refused") as error:
        safe_load(path)
    assert str(path) in str(error.value)
    assert not marker.exists()
    # The same bytes do run in the ordinary unpickler: the test tests something.
    if function is os.system:
        pickle.loads(path.read_bytes())
        assert marker.exists()


def test_object_arrays_in_an_npz_go_the_same_way(tmp_path):
    marker = tmp_path / "ran"
    path = tmp_path / "x.npz"
    good = np.array({"pelvis": 0}, dtype=object)
    np.savez(path, good=good, plain=np.arange(3), bad=np.array([Call(os.system, f"touch {marker}")], dtype=object))
    assert safe_npz(path, keys=["good", "plain"])["good"].item() == {"pelvis": 0}
    with pytest.raises(InputError, match=r"array bad.*system: refused"):
        safe_npz(path)
    assert not marker.exists()


def test_dotted_names_do_not_reach_attributes(tmp_path):
    # Protocol 4 resolves "ndarray.tofile" by attribute access in the ordinary unpickler.
    (tmp_path / "x.pkl").write_bytes(b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93.")
    with pytest.raises(InputError, match=r"numpy\.ndarray\.tofile: refused"):
        safe_load(tmp_path / "x.pkl")


def python2_chumpy_model(monkeypatch) -> bytes:
    """A pickle as Python 2 wrote SMPL files: chumpy objects, a sparse regressor, byte strings."""
    modules = {name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")}
    ch = type("Ch", (), {"__module__": "chumpy.ch"})
    select = type("Select", (), {"__module__": "chumpy.reordering"})
    modules["chumpy.ch"].Ch, modules["chumpy.reordering"].Select = ch, select
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    plain, chosen = ch(), select()
    plain.__dict__ = {"x": np.arange(6.0).reshape(2, 3), "_dirty_vars": set()}
    chosen.__dict__ = {"a": plain, "idxs": np.array([5, 0, 1]), "preferred_shape": (3, 1)}
    data = pickle.dumps(
        {"v_template": plain, "shapedirs": chosen, "J_regressor": scipy.sparse.csc_matrix(np.eye(2, 3)), "s": "\xe9"},
        protocol=0,
    )
    return data.replace(b"copyreg", b"copy_reg").replace(b"scipy.sparse._csc", b"scipy.sparse.csc")


def test_chumpy_and_sparse_objects_are_read_as_records(tmp_path, monkeypatch):
    (tmp_path / "smpl.pkl").write_bytes(python2_chumpy_model(monkeypatch))
    model = safe_load(tmp_path / "smpl.pkl")
    assert isinstance(model["v_template"], InertObject)
    assert model["v_template"].origin == "chumpy.ch.Ch"
    np.testing.assert_array_equal(dense_array(model["v_template"], subject="v"), np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(dense_array(model["shapedirs"], subject="s"), [[5.0], [0.0], [1.0]])
    np.testing.assert_array_equal(dense_array(model["J_regressor"], subject="J"), np.eye(2, 3))


def test_a_sparse_matrix_with_indices_out_of_range_is_an_error(tmp_path):
    matrix = scipy.sparse.csc_matrix(np.eye(3))
    matrix.indices[1] = 1_000_000
    path = write_pickle(tmp_path / "x.pkl", matrix)
    with pytest.raises(InputError, match="consistent sparse matrix"):
        dense_array(safe_load(path), subject="J_regressor")


def test_objects_without_readable_numbers_are_named():
    with pytest.raises(InputError, match="object array"):
        dense_array(np.array([{}, []], dtype=object), subject="weights")


@given(st.binary(max_size=60))
def test_noise_is_an_input_error_or_a_value(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "noise.pkl"
    path.write_bytes(data)
    try:
        safe_load(path)
    except InputError as error:
        assert "noise.pkl" in str(error)


def test_damaged_and_missing_files_are_input_errors(tmp_path):
    whole = pickle.dumps(np.arange(100))
    (tmp_path / "cut.pkl").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.npz").write_text("no archive")
    for read, name in ((safe_load, "cut.pkl"), (safe_load, "none.pkl"), (safe_npz, "text.npz"), (safe_npz, "none.npz")):
        with pytest.raises(InputError, match=name):
            read(tmp_path / name)
    np.savez(tmp_path / "x.npz", a=np.arange(4))
    data = bytearray((tmp_path / "x.npz").read_bytes())
    at = data.find(b"\x93NUMPY")
    data[at + 6 : at + 8] = struct.pack("BB", 9, 9)
    (tmp_path / "x.npz").write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"x\.npz"):
        safe_npz(tmp_path / "x.npz")


def state_of(dtype: str, shape, content) -> bytes:
    """A pickle of an array with this state, as numpy writes them."""
    return pickle.dumps(Parts(dtype, shape, content), protocol=2)


class Parts:
    """Pickles as an array whose state is given, right or wrong."""

    def __init__(self, dtype, shape, content):
        self.state = (1, shape, Kind(dtype), False, content)

    def __reduce__(self):
        return np.zeros(1).__reduce__()[0], (np.ndarray, (0,), b"b"), self.state


class Kind:
    """Pickles as a call of numpy.dtype that numpy itself may refuse."""

    def __init__(self, text):
        self.text = text

    def __reduce__(self):
        return np.dtype, (self.text, False, True)


@pytest.mark.parametrize(
    ("dtype", "shape", "content"),
    [
        ("O8", (4,), b"\x41" * 32),  # pointers from the file
        ("O", (2,), [1]),
        ("V8", (1,), bytes(8)),
        ("f8", (1 << 42,), bytes(8)),
        ("f8", (0, 1 << 62), b""),
        ("f8", (-1,), bytes(8)),
        ("f8", (2.0,), bytes(16)),
        ("U0", (10**12,), b""),
        ("f8", (2,), bytes(15)),
        ("f8", (2,), [1.0, 2.0]),
        ("M8", (1,), bytes(8)),
        ("i8,O", (1,), bytes(16)),
    ],
)
def test_arrays_whose_content_does_not_fit_are_refused_before_they_are_made(tmp_path, dtype, shape, content):
    (tmp_path / "x.pkl").write_bytes(state_of(dtype, shape, content))
    with pytest.raises(InputError, match=r"x\.pkl: expected a readable pickle"):
        safe_load(tmp_path / "x.pkl")


def test_the_same_way_of_writing_gives_arrays_that_do_fit(tmp_path):
    (tmp_path / "x.pkl").write_bytes(state_of("f8", (2,), np.arange(2.0).tobytes()))
    np.testing.assert_array_equal(safe_load(tmp_path / "x.pkl"), [0.0, 1.0])


@pytest.mark.parametrize(
    ("code", "what"),
    [
        (b"\x80\x04]\x94h\x00a.", "within itself"),
        (b"\x80\x04" + b"]" * 300 + b"a" * 299 + b".", "unfold"),
        (b"r\xff\xff\xff\x7f.", "pickle"),
        (b"\x80\x02\x8b\xff\xff\xff\x7f\x01.", "pickle"),
        (b"\x80\x04\x8e" + b"\xff" * 7 + b"\x7f.", "pickle"),
        (b"\x80\x04\x82\x01.", "pickle"),
        (b"Pabc\n.", "pickle"),
        (b"\x80\x05\x97.", "pickle"),
    ],
)
def test_opcodes_that_ask_for_too_much_or_reach_outside(tmp_path, code, what):
    (tmp_path / "x.pkl").write_bytes(code)
    with pytest.raises(InputError, match=what):
        safe_load(tmp_path / "x.pkl")


def test_a_list_of_the_same_list_again_and_again_is_refused(tmp_path):
    value: list = [1.0]
    for _ in range(40):
        value = [value, value]
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(value))
    assert (tmp_path / "x.pkl").stat().st_size < 1000
    with pytest.raises(InputError, match="unfold"):
        safe_load(tmp_path / "x.pkl")


def test_one_content_for_thousands_of_arrays_is_refused(tmp_path):
    content = np.zeros(1 << 20)
    parts = [Parts("f8", content.shape, b"") for _ in range(2000)]
    raw = content.tobytes()
    for part in parts:
        part.state = (*part.state[:4], raw)
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(parts, protocol=4))
    with pytest.raises(InputError, match="many times the file's size"):
        safe_load(tmp_path / "x.pkl")


def test_keys_whose_hashes_a_file_could_choose_are_refused(tmp_path):
    modulus = (1 << 61) - 1
    for value in ({modulus * 3: 1}, {(1, 2): 1}, {1.5: 1}, {modulus * 5}):
        path = write_pickle(tmp_path / "x.pkl", value, protocol=4)
        with pytest.raises(InputError, match="a key of type"):
            safe_load(path)
    assert safe_load(write_pickle(tmp_path / "x.pkl", {np.int64(3): "a", None: 1, b"k": 2, True: 3})) == {
        3: "a",
        None: 1,
        b"k": 2,
        True: 3,
    }


def test_containers_alone_are_changed(tmp_path):
    array = pickle.dumps(np.arange(3), protocol=4)[:-1]
    for code in (b"K\x00K\x07s.", b"K\x07a.", b"(K\x07e.", b"}b."):
        (tmp_path / "x.pkl").write_bytes(array + code)
        with pytest.raises(InputError, match="readable pickle"):
            safe_load(tmp_path / "x.pkl")


def test_shared_and_interned_values_stay_shared(tmp_path):
    array = np.arange(4)
    back = safe_load(write_pickle(tmp_path / "x.pkl", {"a": array, "b": [array, array.T]}, 4))
    assert back["a"] is back["b"][0]


def test_records_that_disagree_with_themselves_are_input_errors():
    sparse = {"data": np.ones(1), "indices": np.zeros(1, int), "indptr": np.array([0, 1])}
    for record in (
        InertObject("scipy.sparse.csc_matrix", (), sparse | {"_shape": (10**9, 10**9)}),
        InertObject("scipy.sparse.csc_matrix", (), sparse | {"_shape": "ab"}),
        InertObject("scipy.sparse.csc_matrix", (), sparse | {"_shape": (7, 7)}),
        InertObject("chumpy.reordering.Select", (), {"a": np.arange(3), "idxs": np.array([9])}),
        InertObject("chumpy.reordering.Select", (), {"a": np.arange(3), "idxs": "x"}),
        InertObject("chumpy.ch.Ch", (), {"x": [[1, 2], [3]]}),
    ):
        with pytest.raises(InputError, match="regressor"):
            dense_array(record, subject="regressor")
