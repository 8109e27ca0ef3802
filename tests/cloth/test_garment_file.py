"""Garments as a file: the same bits again; damaged, foreign and newer files are refused."""

from __future__ import annotations

import json
from dataclasses import asdict, fields, replace

import numpy as np
import pytest

from smplxpp.cloth import Fabric, GarmentConfig
from smplxpp.cloth.garment_file import load_garments, save_garments
from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import read_arrays, write_arrays
from tests.cloth.persons import person
from tests.cloth.test_driver import garment

_ABOUT = "smplxpp_garments"


@pytest.fixture
def path(tmp_path):
    config = replace(garment().config, pin_depth=0.0213, fabric=Fabric(drag=1 / 3, slack=0.07))
    save_garments(tmp_path / "garments.npz", [garment().with_config(config), garment()])
    return tmp_path / "garments.npz"


def test_what_is_read_is_what_was_written(path, tmp_path):
    first, second = load_garments(path, person())
    assert first.config.pin_depth == 0.0213 and first.config.fabric == Fabric(drag=1 / 3, slack=0.07)
    assert second.config == garment().config
    assert second.part == garment().part
    for name in ("particles", "lengths", "depth", "vertices", "vertex_depth"):
        one, other = getattr(second, name), getattr(garment(), name)
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    for holder in ("embedding", "collider"):
        for field in fields(getattr(second, holder)):
            np.testing.assert_array_equal(
                getattr(getattr(second, holder), field.name), getattr(getattr(garment(), holder), field.name)
            )
    np.testing.assert_array_equal(second.rest.vertices, garment().rest.vertices)
    np.testing.assert_array_equal(second.rest.edges, garment().rest.edges)
    for name, value in second.reference.as_dict().items():
        np.testing.assert_array_equal(value, garment().reference.as_dict()[name])
    save_garments(tmp_path / "again.npz", [first, second])
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


def test_no_garment_is_a_file_too(tmp_path):
    save_garments(tmp_path / "none.npz", [])
    assert load_garments(tmp_path / "none.npz", person()) == []


def changed(path, **arrays):
    """The file with other arrays; None leaves one out."""
    own = read_arrays(path)
    for name, value in arrays.items():
        key = name if name == _ABOUT else name.replace("__", ".")
        if value is None:
            own.pop(key)
        else:
            own[key] = value(own[key]) if callable(value) else value
    write_arrays(path, own)


def set_first(value):
    """Put a value into an array's first place."""

    def change(array):
        array = array.copy()
        array.flat[0] = value
        return array

    return change


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("particles", None),
        ("particles", lambda a: a.astype(np.int32)),
        ("particles", set_first(10**6)),
        ("vertices", set_first(-1)),
        ("corners", set_first(5000)),
        ("rest_faces", set_first(5000)),
        ("collider_faces", set_first(-3)),
        ("collider_vertices", set_first(2**40)),
        ("rest_vertices", set_first(np.nan)),
        ("rest_vertices", lambda a: a[:-1]),
        ("rest_vertices", set_first(1e300)),
        ("depth", set_first(np.nan)),
        ("offset", set_first(np.inf)),
        ("lengths", lambda a: a[:-1]),
        ("weights", lambda a: a[:, :2]),
        ("collider_margin", lambda a: a[:-1]),
        ("params.transl", lambda a: a * np.nan),
        ("params.transl", lambda a: a[:, :2]),
    ],
)
def test_arrays_that_are_not_a_garments_are_refused(path, name, value):
    changed(path, **{f"1__{name}": value})
    with pytest.raises(InputError, match=r"garment|parameter transl"):
        load_garments(path, person())


def about(config=None, **changes):
    one = {"part": "lower", "config": asdict(GarmentConfig()) if config is None else config}
    return np.array(json.dumps({"schema": 1, "garments": [one, one], **changes}))


@pytest.mark.parametrize(
    "text",
    [
        np.array("{"),
        np.array("[]"),
        np.array(3),
        about(schema=2),
        about(schema="one"),
        about(garments={}),
        about(garments=[3]),
        about(config={}),
        about(config={**asdict(GarmentConfig()), "spacing": 0.0}),
        about(config={**asdict(GarmentConfig()), "fabric": {}}),
        about(config={**asdict(GarmentConfig()), "band": "wide"}),
    ],
)
def test_descriptions_that_say_nothing_are_refused(path, text):
    changed(path, **{_ABOUT: text})
    with pytest.raises(InputError):
        load_garments(path, person())


def test_other_files_and_other_templates_are_refused(path, tmp_path):
    write_arrays(tmp_path / "other.npz", {"a": np.arange(3)})
    (tmp_path / "text.npz").write_text("no npz")
    for file in ("other.npz", "text.npz", "missing.npz"):
        with pytest.raises(InputError):
            load_garments(tmp_path / file, person())
    from tests.dolls.dancing import template

    with pytest.raises(InputError, match="another template"):
        load_garments(path, template())


def test_a_template_that_was_built_anew_is_another_one(path):
    it = person()
    moved = replace(it, vertices=it.vertices + 0.002 * np.sin(50 * it.vertices))
    with pytest.raises(InputError, match="of another template"):
        load_garments(path, moved)


def test_a_newer_file_asks_for_a_newer_program(path):
    changed(path, **{_ABOUT: about(schema=7)})
    with pytest.raises(InputError, match="Update smplxpp"):
        load_garments(path, person())
