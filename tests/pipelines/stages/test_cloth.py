"""The stage of the loose clothes: which parts it takes, what it fits them to, and what it says of the others."""

from __future__ import annotations

from dataclasses import replace

import pytest

from avatar.data.sequence import AvatarSequence
from avatar.training.engine.session import Session
from pipelines.report.sections.training import cloth_section
from pipelines.runs.stage import StageOutput, run_stage
from pipelines.stages.cloth import ClothConfig, Outlines, _checks, _numbers_of, find_garments, measure_outlines
from smplxpp.capture import open_capture
from smplxpp.cloth.calibrate import CalibrationConfig
from smplxpp.core.errors import InputError
from tests.cloth.persons import PART, person, standing
from tests.dolls.skirted import COARSE, FPS, followed, garment, moved, write_skirted
from tests.runs.stages import stage_of

CONFIG = ClothConfig(garment=COARSE, calibration=CalibrationConfig(drags=(1.0, 4.0), pin_depths=(0.014,), blocks=2))


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> AvatarSequence:
    return AvatarSequence(open_capture(write_skirted(tmp_path_factory.mktemp("captures") / "skirt")), person())


def find(sequence, tmp_path, *, track=None, reference=None, config=CONFIG):
    return find_garments(sequence, reference, config, track, Session(tmp_path))


def test_a_skirt_that_swings_is_found_and_its_drag_with_it(sequence, tmp_path):
    garments, found, outlines, said = find(sequence, tmp_path, track=followed(moved()), reference=standing())
    assert [garment.part for garment in garments] == [PART] and said == []
    (one,) = found
    assert one.moves and one.frames == 10 and one.simulated < one.skinned
    assert outlines[PART].better and outlines[PART].views > 0


def test_a_skirt_that_follows_the_joints_is_left_to_the_field(sequence, tmp_path):
    garments, (one,), outlines, _ = find(sequence, tmp_path, track=followed(0 * moved()), reference=standing())
    assert garments == [] and not one.moves and outlines == {}


def test_named_parts_are_simulated_whatever_was_followed(sequence, tmp_path):
    named = replace(CONFIG, parts=(PART,))
    for track in (None, followed(0 * moved())):
        garments, *_ = find(sequence, tmp_path, track=track, reference=standing(), config=named)
        assert [garment.part for garment in garments] == [PART]
    with pytest.raises(InputError, match="loose parts"):
        find(sequence, tmp_path, reference=standing(), config=replace(CONFIG, parts=("cape",)))


def test_what_cannot_be_done_is_said(sequence, tmp_path, caplog):
    nothing = find(sequence, tmp_path, reference=standing())
    assert nothing[0] == [] and "named" in nothing[3][0]
    unknown = find(sequence, tmp_path, track=followed(moved()))
    assert unknown[0] == [] and "pose" in unknown[3][0]
    timeless = replace(sequence.capture, recording=replace(sequence.capture.recording, fps=None))
    slow = AvatarSequence(timeless, person())
    unsaid = find(slow, tmp_path, track=followed(moved()), reference=standing())
    assert unsaid[0] == [] and "frames a second" in unsaid[3][0]
    wide = AvatarSequence(sequence.capture, person(tight=False))
    loose = find(wide, tmp_path, track=followed(moved()), reference=standing())
    assert loose[0] == [] and PART in loose[3][0]
    said = [(record.levelname, record.message) for record in caplog.records]  # the rest is said before trainings begin
    assert said == [("WARNING", f"loose clothes: {loose[3][0]}")]
    assert find(sequence, tmp_path, config=replace(CONFIG, parts=())) == ([], [], {}, [])


def test_outlines_are_of_silhouettes_against_masks(sequence):
    outlines = measure_outlines(sequence, garment(), FPS)
    assert 0 < outlines.simulated < outlines.skinned < 0.5
    assert Outlines(0.2, 0.1, 4).better and not Outlines(0.1, 0.2, 4).better


def test_the_report_says_what_was_found_and_what_was_not(sequence, tmp_path):
    garments, found, outlines, _ = find(sequence, tmp_path, track=followed(moved()), reference=standing())
    numbers = {
        "loose": [garment.part for garment in garments],
        "calibration": {one.part: _numbers_of(one, outlines.get(one.part)) for one in found}
        | {"outer": _numbers_of(replace(found[0], part="outer", moves=False, drag_spread=None, pin_spread=None), None)},
        "said": ["hair: nothing holds it"],
    }
    record = run_stage(tmp_path, stage_of("83_cloth"), lambda folder: StageOutput(_checks(outlines, garments), numbers))
    section = cloth_section(record)
    rows = {row[0]: row[1:] for row in section.tables[0].rows}
    assert rows[PART][0] == "simulated" and "+-" in rows[PART][5]
    assert rows["outer"][0] == "left to the field" and rows["outer"][2:6] == ("-", "-", "-", "-")
    assert "hair: nothing holds it" in section.text
    assert [check.name for check in section.checks] == [f"{PART}: wrong outline with it simulated"]
