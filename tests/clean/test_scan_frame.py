"""Units and upward axis of a scan are found from its shape."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.body.named_poses import low_poses, standing_poses
from smplxpp.clean.scan_frame import METRES_PER_UNIT, check_human_scale, convert_points, find_scan_frame
from smplxpp.core import BodyParams, InputError, TriangleMesh, matrix_from_rotvec


@pytest.fixture(scope="module")
def person() -> TriangleMesh:
    """The mean body with lowered arms, its left foot before the other, facing 50 degrees to her left."""
    body = load_body()
    pose = dict(standing_poses(body.joint_count))["arms lowered, legs walking"].copy()
    pose[0] = [0.0, np.radians(50.0), 0.0]
    params = BodyParams.from_full_pose(
        pose[None], betas=np.zeros((1, 1)), expression=np.zeros((1, 1)), transl=np.zeros((1, 3))
    )
    return body.mesh(body.forward(params).vertices[0])


@pytest.mark.parametrize(("units", "up"), [("cm", "z"), ("mm", "-x")])
@pytest.mark.long
def test_units_and_axis_are_found_back(person, units, up):
    axes = convert_points(np.eye(3), up=up)
    filed = person.vertices @ axes.T / METRES_PER_UNIT[units]
    assert np.allclose(convert_points(filed, units=units, up=up), person.vertices)
    found = find_scan_frame(filed, person.faces)
    assert (found.units, found.up, found.unambiguous) == (units, up, True)
    assert units in found.note
    assert up in found.note


@pytest.mark.parametrize("name", ["legs stretched out, arms hanging", "on the heels, arms forwards"])
def test_who_sits_on_the_floor_does_not_lie(name):
    """Legs along z and a trunk along y: standing poses had z up, and the size then forbade every other axis."""
    body, rng = load_body(), np.random.default_rng(1)
    pose = dict(low_poses(body.joint_count))[name] + np.radians(4.0) * rng.normal(size=(body.joint_count, 3))
    pose[0] = [0.0, 1.1, 0.0]
    params = BodyParams.from_full_pose(
        pose[None], betas=np.zeros((1, 1)), expression=np.zeros((1, 1)), transl=np.zeros((1, 3))
    )
    vertices = body.forward(params).vertices[0]
    filed = vertices @ convert_points(np.eye(3), up="z").T
    found = find_scan_frame(filed, body.faces, units="m")
    assert (found.up, found.unambiguous) == ("z", True)
    check_human_scale(vertices, axes=False)


def test_what_is_stated_is_kept(person):
    found = find_scan_frame(person.vertices, person.faces, units="cm", up="-z")
    assert (found.units, found.up) == ("cm", "-z")
    assert "stated units cm" in found.note


def test_stray_points_and_faces_that_point_inward_change_nothing(person):
    vertices = np.concatenate([person.vertices, [[1e6, 0, 0], [np.nan, 0, 0]]])
    found = find_scan_frame(vertices, person.faces[:, ::-1], up="y")
    assert (found.units, found.up) == ("m", "y")


def test_a_size_that_is_nobodys_in_any_unit_is_refused(person):
    with pytest.raises(InputError, match=r"a person .* m high"):
        find_scan_frame(person.vertices * 7.0, person.faces, up="y")


def test_no_surface_is_refused(person):
    with pytest.raises(InputError, match="a surface with faces"):
        find_scan_frame(person.vertices, person.faces[:0])


def test_a_leaning_person_is_upright_enough(person):
    lean = matrix_from_rotvec(np.radians([15.0, 0.0, 5.0]))
    assert find_scan_frame(person.vertices @ lean.T, person.faces).up == "y"


# --- sizes in no unit ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1.0, 989.0, 20.0])
def test_a_size_in_no_unit_is_asked_about(person, size):
    """989 voxels were taken for millimetres, and a person scaled to 1 for one of a metre, without a word."""
    scaled = person.vertices / np.ptp(person.vertices[:, 1]) * size
    with pytest.raises(
        InputError, match=rf"received {size:g} from head.*{size:g} mm \({size / 1000:.3g} m\).*--height"
    ):
        find_scan_frame(scaled, person.faces, up="y")


def test_data_scaled_to_minus_one_and_one_is_asked_about(person):
    low, high = person.vertices[:, 1].min(), person.vertices[:, 1].max()
    scaled = (person.vertices - [0, 0.5 * (low + high), 0]) * 2.0 / (high - low)
    with pytest.raises(InputError, match="from -1 to 1"):
        find_scan_frame(scaled, person.faces, up="y")
    assert find_scan_frame(scaled, person.faces, units="m", up="y").units == "m"
    assert find_scan_frame(scaled + [0, 1, 0], person.faces, up="y").units == "m"  # who stands on the floor is 2 m high


def test_a_stated_height_gives_the_scale_whatever_lies_around(person):
    vertices = np.concatenate([person.vertices * 7.0, [[0, 1e4, 0]]])
    faces = np.concatenate([person.faces, [[len(vertices) - 1] * 2 + [0]]])
    found = find_scan_frame(vertices, faces, up="y", height=1.75)
    assert isinstance(found.units, float) and found.up == "y" and "stated height 1.75 m" in found.note
    metres = convert_points(person.vertices * 7.0, units=found.units, up=found.up)
    assert np.ptp(metres[:, 1]) == pytest.approx(1.75)


@pytest.mark.parametrize(("height", "units", "words"), [(175.0, "auto", "175"), (1.75, "cm", "both: units cm")])
def test_heights_that_are_none_are_refused(person, height, units, words):
    with pytest.raises(InputError, match=f"option height.*{words}"):
        find_scan_frame(person.vertices, person.faces, units=units, height=height)


def test_the_axis_of_the_files_format_is_kept_where_no_other_fits_clearly_better(person, monkeypatch):
    """The glTF file of a kneeling woman, with these distances to standing bodies, was turned upside down."""
    kneeling = {"y": 0.166, "z": 0.204, "x": 0.234, "-y": 0.157, "-z": 0.211, "-x": 0.232}
    monkeypatch.setattr("smplxpp.clean.scan_frame._bodies", list)
    monkeypatch.setattr("smplxpp.clean.scan_frame._cost", lambda surface, bodies, up: kneeling[up])
    found = find_scan_frame(person, usual="y")
    assert found.up == "y" and not found.unambiguous and "though -y fits nearly as well" in found.note
    assert find_scan_frame(person).up == find_scan_frame(person, usual="z").up == "-y"
