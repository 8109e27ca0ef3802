import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import (
    as_integer,
    as_list,
    as_number,
    as_numbers,
    as_object,
    as_text,
    parse_json,
    read_json,
)

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("[" * 100 + "]" * 100, "levels"),
        ("[" * 100_000, "levels"),
        ('{"a":' * 70 + "1" + "}" * 70, "levels"),
        ("1" * 5000, "5000 digits"),
        ('{"frame": 1000000000000000000000}', "22 digits"),
        ("{'a': 1}", "JSON"),
        ('{"name": "a\\u0000b"}', "NUL"),
        ('["\\ud800"]', "half a character"),
        ('{"\\udfff": 1}', "half a character"),
        ("", "JSON"),
    ],
)
def test_what_no_reader_could_bear_is_refused(tmp_path, text, what):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InputError, match=what) as error:
        read_json(tmp_path / "x.json")
    assert "x.json" in str(error.value)


def test_whole_pairs_of_surrogates_and_a_byte_order_mark_are_read(tmp_path):
    (tmp_path / "x.json").write_bytes(b'\xef\xbb\xbf{"a": "\\ud83d\\ude00", "b": ' + b"[" * 60 + b"]" * 60 + b"}")
    assert read_json(tmp_path / "x.json")["a"] == "\N{GRINNING FACE}"


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "x.json").write_bytes(b'{"a": "\xff\xfe\xff"}')
    with pytest.raises(InputError, match="JSON"):
        read_json(tmp_path / "x.json")


@pytest.mark.parametrize("value", [None, True, "3", [3], {}, float("nan"), float("inf"), 10**400])
def test_what_is_no_number_is_refused(value):
    with pytest.raises(InputError, match="width"):
        as_number(value, subject="width")
    with pytest.raises(InputError, match="width"):
        as_integer(value, subject="width")


def test_bounds_and_kinds_of_numbers():
    assert as_number(np.float32(2.5), subject="x") == 2.5 and as_number(-3, subject="x") == -3.0
    assert as_integer(3.0, subject="x") == 3 and type(as_integer(np.int64(3), subject="x")) is int
    for value in (0, 11, 2.5):
        with pytest.raises(InputError, match="from 1 to 10"):
            as_integer(value, subject="x", least=1, most=10)
    with pytest.raises(InputError, match="from 0 to 1"):
        as_number(1.5, subject="x", least=0, most=1)


@pytest.mark.parametrize(
    "value", [[[1, 2], [3]], [["1", 2, 3]], [[True, 2, 3]], [[1, 2, None]], {"a": 1}, "abc", [[1, 2, float("nan")]]]
)
def test_lists_that_are_no_numbers_are_refused(value):
    with pytest.raises(InputError, match=r"R: expected finite numbers of shape \(any, 3\)"):
        as_numbers(value, (None, 3), subject="R")


def test_numbers_have_the_shape_asked_for():
    np.testing.assert_array_equal(as_numbers([[1, 2, 10**30]], (None, 3), subject="R"), [[1, 2, 1e30]])
    np.testing.assert_array_equal(as_numbers(np.arange(3), (3,), subject="R"), [0.0, 1.0, 2.0])
    with pytest.raises(InputError, match=r"received shape \(2,\)"):
        as_numbers([1, 2], (3,), subject="R")
    with pytest.raises(InputError):
        as_numbers([10**400], subject="R")


@given(json_values)
def test_accessors_return_the_kind_they_promise_or_refuse(value):
    for read, kind in ((as_object, dict), (as_list, list), (as_text, str), (as_number, float), (as_integer, int)):
        try:
            assert type(read(value, subject="x")) is kind
        except InputError as error:
            assert len(str(error)) < 500
    try:
        assert as_numbers(value, subject="x").dtype == np.float64
    except InputError:
        pass


@given(st.text(max_size=40) | st.binary(max_size=40))
def test_noise_is_a_value_or_an_input_error(data):
    try:
        parse_json(data, subject="noise")
    except InputError as error:
        assert "noise" in str(error)
