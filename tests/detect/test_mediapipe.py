"""MediaPipe on the fixture's photographs, where it is installed; and what is said where it is not."""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.capture import open_capture
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.register import LandmarkModel
from tests.conftest import ROOT

FIXTURE = ROOT / "data" / "fixtures" / "person"
CAMERA = "Cam001"
FRONT = ("nose", "coco_left_shoulder", "coco_right_shoulder", "coco_left_elbow", "coco_right_elbow", "coco_left_wrist")
GREY = 150


@pytest.fixture(scope="module")
def detector():
    pytest.importorskip("mediapipe", exc_type=ImportError)
    from smplxpp.detect.mediapipe_detector import MediaPipeDetector

    return MediaPipeDetector()


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    """The person on grey."""
    capture = open_capture(FIXTURE)
    return np.round(255 * capture.composited(CAMERA, 0, (GREY / 255,) * 3)).astype(np.uint8)


def truth() -> dict[str, np.ndarray]:
    """Where the body's landmarks are in the photograph."""
    body, capture = load_body(), open_capture(FIXTURE)
    posed = body.forward(capture.params(0))
    model = LandmarkModel.of(body, FRONT)
    pixels = capture.cameras[CAMERA].screen_from_world(model.points(posed.vertices[0], posed.joints[0]))
    return dict(zip(model.names, pixels[:, :2], strict=True))


def test_the_points_of_a_person_are_where_they_are(detector, photograph):
    (person,) = detector(photograph)
    found = dict(zip(detector.names, person.points, strict=True))
    apart = [np.linalg.norm(found[name] - uv) for name, uv in truth().items()]
    # The person is 500 pixels high: 1 % of that is 17 mm.
    assert np.median(apart) < 6 and max(apart) < 20
    assert person.confidence.min() >= 0 and person.confidence.max() <= 1


def test_left_is_the_persons_left(detector, photograph):
    """Of a person who faces the camera, the left side is on the right of the image; in a mirror it is so again."""
    for image in (photograph, photograph[:, ::-1]):
        found = dict(zip(detector.names, detector(image)[0].points, strict=True))
        for part in ("coco_{}_shoulder", "coco_{}_hip", "{}_eye", "{}_big_toe"):
            assert found[part.format("left")][0] > found[part.format("right")][0]


def test_a_box_changes_nothing_but_where_it_looks(detector, photograph):
    (whole,) = detector(photograph)
    (cut,) = detector(photograph, whole.box)
    sure = (whole.confidence > 0.9) & (cut.confidence > 0.9)
    assert sure.sum() > 20
    assert np.median(np.linalg.norm(whole.points - cut.points, axis=1)[sure]) < 4


def test_nobody_is_found_where_nobody_is(detector):
    assert detector(np.full((200, 150, 3), GREY, np.uint8)) == []
    assert detector(np.zeros((8, 8, 3), np.uint8)) == []
    assert detector(np.zeros((200, 150, 3), np.uint8), (0.0, 0.0, 4.0, 4.0)) == []


def test_two_people_are_told_and_the_surest_comes_first(detector, photograph):
    height, width = photograph.shape[:2]
    both = np.full((height, 2 * width, 3), GREY, np.uint8)
    both[:, :width] = photograph
    both[:, width:] = photograph[:, ::-1]
    people = detector(both)
    assert len(people) == 2
    assert people[0].total_confidence >= people[1].total_confidence
    middles = sorted(0.5 * (one.box[0] + one.box[2]) / width for one in people)
    assert 0 < middles[0] < 1 < middles[1] < 2
    apart = detector(both, people[1].box)
    assert abs(apart[0].box[0] - people[1].box[0]) < 0.1 * width


def test_the_same_image_gives_the_same_points(detector, photograph):
    one, again = detector(photograph)[0], detector(photograph)[0]
    np.testing.assert_array_equal(one.points, again.points)


def test_the_person_is_cut_out(detector):
    from smplxpp.detect.mediapipe_detector import PersonSegmenter

    capture = open_capture(FIXTURE)
    image = np.round(255 * capture.composited(CAMERA, 0, (GREY / 255,) * 3)).astype(np.uint8)
    matte, mask = PersonSegmenter()(image) > 127, capture.mask(CAMERA, 0) > 127
    assert (matte & mask).sum() / (matte | mask).sum() > 0.9


@pytest.mark.parametrize("degrees", [0.0, 40.0, 180.0])
@pytest.mark.parametrize(("turn", "behind"), [(0.0, False), (60.0, False), (85.0, False), (120.0, True), (180.0, True)])
def test_a_head_from_behind_has_its_left_ear_on_the_left(turn, behind, degrees):
    """A head is turned about its axis by `turn`; the camera is rolled by `degrees`."""
    from smplxpp.detect.mediapipe_detector import _from_behind

    head = np.zeros((33, 3))  # x to the image's right, y down, z towards the camera
    head[7], head[8] = (75, 0, 0), (-75, 0, 0)
    head[2], head[5] = (32, -20, 70), (-32, -20, 70)
    head[9], head[10] = (25, 40, 70), (-25, 40, 70)
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    seen = (head @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T)[:, :2]
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    assert _from_behind(seen @ np.array([[c, -s], [s, c]]).T) == behind


def test_what_is_missing_is_said_with_the_command_to_type(monkeypatch):
    from smplxpp.detect.mediapipe_detector import MediaPipeDetector, PersonSegmenter

    monkeypatch.setitem(sys.modules, "mediapipe", None)
    for make in (MediaPipeDetector, PersonSegmenter):
        with pytest.raises(MissingExtraError, match=r"pip install .*extra detect"):
            make()


def test_a_mediapipe_without_its_models_is_refused(monkeypatch):
    from smplxpp.detect.mediapipe_detector import MediaPipeDetector

    later = types.ModuleType("mediapipe")
    later.__version__ = "0.10.33"
    monkeypatch.setitem(sys.modules, "mediapipe", later)
    with pytest.raises(InputError, match=r"0\.10\.14 to 0\.10\.21.*0\.10\.33"):
        MediaPipeDetector()
