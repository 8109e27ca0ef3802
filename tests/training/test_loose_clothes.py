"""Loose clothes: which parts are simulated, what they are fitted to, and the notes on the others."""

from __future__ import annotations

from dataclasses import replace

import pytest

from avatar.data.sequence import AvatarSequence
from avatar.training.loose_clothes import ClothConfig, LooseClothes, Outlines, find_garments, measure_outlines
from smplxpp.capture import open_capture
from smplxpp.cloth.calibrate import CalibrationConfig
from smplxpp.core.errors import InputError
from tests.cloth.persons import PART, person, standing
from tests.dolls.skirted import COARSE, FPS, followed, garment, moved, write_skirted

CONFIG = ClothConfig(garment=COARSE, calibration=CalibrationConfig(drags=(1.0, 4.0), pin_depths=(0.014,), blocks=2))


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> AvatarSequence:
    return AvatarSequence(open_capture(write_skirted(tmp_path_factory.mktemp("captures") / "skirt")), person())


def find(sequence, *, track=None, reference=None, config=CONFIG):
    return find_garments(sequence, reference, config, track)


@pytest.mark.long
def test_a_skirt_that_swings_is_found_and_its_drag_with_it(sequence):
    found = find(sequence, track=followed(moved()), reference=standing())
    assert [garment.part for garment in found.garments] == [PART] and found.notes == []
    (one,) = found.calibrations
    assert one.moves and one.frames == 10 and one.simulated < one.skinned
    assert found.outlines[PART].better and found.outlines[PART].views > 0


def test_a_skirt_that_follows_the_joints_is_left_to_the_field(sequence):
    found = find(sequence, track=followed(0 * moved()), reference=standing())
    (one,) = found.calibrations
    assert found.garments == [] and not one.moves and found.outlines == {}


def test_named_parts_are_simulated_whatever_was_followed(sequence):
    named = replace(CONFIG, parts=(PART,))
    for track in (None, followed(0 * moved())):
        found = find(sequence, track=track, reference=standing(), config=named)
        assert [garment.part for garment in found.garments] == [PART]
    with pytest.raises(InputError, match="loose parts"):
        find(sequence, reference=standing(), config=replace(CONFIG, parts=("cape",)))


def test_what_cannot_be_simulated_is_noted(sequence, caplog):
    nothing = find(sequence, reference=standing())
    assert nothing.garments == [] and "named" in nothing.notes[0]
    unknown = find(sequence, track=followed(moved()))
    assert unknown.garments == [] and "pose" in unknown.notes[0]
    timeless = replace(sequence.capture, recording=replace(sequence.capture.recording, fps=None))
    slow = AvatarSequence(timeless, person())
    unsaid = find(slow, track=followed(moved()), reference=standing())
    assert unsaid.garments == [] and "frames a second" in unsaid.notes[0]
    wide = AvatarSequence(sequence.capture, person(tight=False))
    loose = find(wide, track=followed(moved()), reference=standing())
    assert loose.garments == [] and PART in loose.notes[0]
    said = [(record.levelname, record.message) for record in caplog.records]  # the rest is said before trainings begin
    assert said == [("WARNING", f"loose clothes: {loose.notes[0]}")]
    assert find(sequence, config=replace(CONFIG, parts=())) == LooseClothes()


def test_outlines_are_of_silhouettes_against_masks(sequence):
    outlines = measure_outlines(sequence, garment(), FPS)
    assert 0 < outlines.simulated < outlines.skinned < 0.5
    assert Outlines(0.2, 0.1, 4).better and not Outlines(0.1, 0.2, 4).better
