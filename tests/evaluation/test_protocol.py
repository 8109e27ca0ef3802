"""Which views are measured: by the splits, evenly, the same ones every time, never none without a word."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from avatar.evaluation.protocol import SETS, ProtocolConfig, ViewSet, truth_frames, view_sets, with_people
from smplxpp.capture import open_capture
from smplxpp.core.errors import GeometryWarning, InputError
from tests.dolls.standing import HELD_OUT, NOVEL, TRAIN, opened, write_frames


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return opened(tmp_path_factory.mktemp("capture") / "doll")


def test_sets_are_apart_in_cameras_and_frames(capture):
    sets = view_sets(capture, ProtocolConfig(every=1, training_every=1))
    assert list(sets) == list(SETS)
    for name, cameras, frames in (
        ("training", TRAIN, range(4)),
        ("novel_view", HELD_OUT, range(4)),
        ("novel_pose", HELD_OUT, NOVEL),
        ("novel_pose_training_view", TRAIN, NOVEL),
    ):
        assert {c for c, _ in sets[name].views} <= set(cameras) and sets[name].frames == tuple(frames)
    assert len(sets["novel_view"].views) == 8 and len(sets["novel_pose"].views) == 4
    pairs = [pair for one in sets.values() for pair in one.views]
    assert len(pairs) == len(set(pairs))


def test_every_nth_frame_and_training_cameras_in_turn(capture):
    config = ProtocolConfig(every=2, training_every=2, cameras_a_frame=3)
    sets = view_sets(capture, config)
    assert sets["novel_view"].frames == (0, 2) and sets["novel_pose"].frames == (4,)
    by_frame = {f: {c for c, g in sets["training"].views if g == f} for f in (0, 2)}
    assert len(by_frame[0]) == len(by_frame[2]) == 3 and not by_frame[0] & by_frame[2]
    all_of_them = view_sets(capture, ProtocolConfig(training_every=1, cameras_a_frame=99))["training"].views
    assert len(all_of_them) == 4 * len(TRAIN)
    assert view_sets(capture, config) == sets


def test_the_users_choice_replaces_the_splits(capture):
    config = ProtocolConfig(every=1, training_every=1, held_out_cameras=("Ring0",), held_out_frames=(2, 1))
    sets = view_sets(capture, config)
    assert sets["novel_pose"].views == (("Ring0", 1), ("Ring0", 2))
    assert sets["training"].frames == (0, 3) and "Ring0" not in {c for c, _ in sets["training"].views}
    assert list(view_sets(capture, ProtocolConfig(sets=("novel_pose",)))) == ["novel_pose"]


def test_every_held_out_frame_of_every_held_out_camera_by_default(capture):
    sets = view_sets(capture, ProtocolConfig())
    assert set(sets["novel_pose"].views) == {(camera, frame) for camera in HELD_OUT for frame in NOVEL}
    assert set(sets["novel_view"].views) == {(camera, frame) for camera in HELD_OUT for frame in range(4)}
    assert sets["novel_pose_training_view"].frames == NOVEL
    assert sets["training"].frames == (0,)
    # Of the held-out frames 4 and 5, and of the training frames 0 to 3, odd ones have a surface.
    assert truth_frames(capture, ProtocolConfig(), sets) == {"training": (1,), "held_out": (5,)}


def test_training_frames_are_never_taken_more_often_than_held_out_ones():
    assert ProtocolConfig().training_step == 4
    assert ProtocolConfig(every=8).training_step == 8
    assert ProtocolConfig(every=8, training_every=10).training_step == 10


def test_surfaces_are_looked_for_where_views_need_not_be(capture):
    # Odd frames have a surface: the first of every two frames has none.
    config = ProtocolConfig(every=2, training_every=2)
    sets = view_sets(capture, config)
    assert truth_frames(capture, config, sets) == {"training": (1, 3), "held_out": (5,)}
    only = view_sets(capture, ProtocolConfig(every=2, sets=("novel_view",)))
    assert truth_frames(capture, config, only) == {"training": (1, 3)}


def test_an_empty_set_is_an_error_if_it_was_asked_for(tmp_path):
    root = write_frames(tmp_path / "doll")
    (root / "capture.json").write_text("{}")
    capture = open_capture(root)
    assert list(view_sets(capture, ProtocolConfig())) == ["training"]
    with pytest.raises(InputError, match=r"novel views.*--hold-out"):
        view_sets(capture, ProtocolConfig(sets=("novel_view",)))


def test_frames_without_parameters_are_named(tmp_path):
    root = write_frames(tmp_path / "doll")
    (root / "params" / "000004.npz").unlink()
    with pytest.raises(InputError, match="none for 4"):
        view_sets(open_capture(root), ProtocolConfig(every=1))


def test_views_without_anybody_are_left_out(tmp_path):
    root = write_frames(tmp_path / "doll")

    def wipe(camera: str, frame: int) -> None:
        for folder, tag in (("rgbs", "rgb"), ("masks", "mask")):
            path = root / folder / camera / f"{camera}_{tag}{frame:06d}.png"
            Image.fromarray(np.zeros_like(np.asarray(Image.open(path)))).save(path)

    wipe("Held0", 4)
    config = ProtocolConfig(every=2)
    with pytest.warns(GeometryWarning, match="novel poses: no person in the masks of 1 of 2"):
        sets = with_people(open_capture(root), view_sets(open_capture(root), config))
    assert sets["novel_pose"].views == (("Held1", 4),)
    wipe("Held1", 4)
    capture = open_capture(root)
    with pytest.warns(GeometryWarning), pytest.raises(InputError, match="some for novel poses"):
        with_people(capture, view_sets(capture, config))


def test_an_image_of_another_size_is_told_before_work_starts(tmp_path):
    root = write_frames(tmp_path / "doll")
    Image.fromarray(np.zeros((9, 9, 3), np.uint8)).save(root / "rgbs" / "Held1" / "Held1_rgb000000.png")
    capture = open_capture(root)
    with pytest.raises(InputError, match="Held1"):
        with_people(capture, view_sets(capture, ProtocolConfig()))


@pytest.mark.parametrize("options", [{"sets": ("novel",)}, {"every": 0}, {"training_every": 0}, {"cameras_a_frame": 0}])
def test_unusable_choices_are_refused(options):
    with pytest.raises(InputError, match=next(iter(options)).split("_")[0]):
        ProtocolConfig(**options)


def test_unknown_cameras_and_frames_are_named(capture):
    with pytest.raises(InputError, match="Nowhere"):
        view_sets(capture, ProtocolConfig(held_out_cameras=("Nowhere",)))
    with pytest.raises(InputError, match="77"):
        view_sets(capture, ProtocolConfig(held_out_frames=(77,)))


def test_shown_views_are_spread():
    views = tuple((f"c{k}", k) for k in range(7))
    assert ViewSet("training", views).spread(3) == (views[0], views[3], views[6])
    assert ViewSet("training", views[:2]).spread(5) == views[:2]
    assert ViewSet("training", views).spread(0) == ()
