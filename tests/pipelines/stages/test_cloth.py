"""The stage of the loose clothes in the report."""

from __future__ import annotations

from dataclasses import replace

import pytest

from avatar.data.sequence import AvatarSequence
from avatar.training.loose_clothes import find_garments
from pipelines.report.sections.training import cloth_section
from pipelines.runs.stage import StageOutput, run_stage
from pipelines.stages.cloth import _checks, _numbers_of
from smplxpp.capture import open_capture
from tests.cloth.persons import PART, person, standing
from tests.dolls.skirted import followed, moved, write_skirted
from tests.runs.stages import stage_of
from tests.training.test_loose_clothes import CONFIG


@pytest.mark.long
def test_the_report_says_what_was_found_and_what_was_not(tmp_path):
    sequence = AvatarSequence(open_capture(write_skirted(tmp_path / "skirt")), person())
    found = find_garments(sequence, standing(), CONFIG, followed(moved()))
    numbers = {
        "loose": [garment.part for garment in found.garments],
        "calibration": {one.part: _numbers_of(one, found.outlines.get(one.part)) for one in found.calibrations}
        | {
            "outer": _numbers_of(
                replace(found.calibrations[0], part="outer", moves=False, drag_spread=None, pin_spread=None), None
            )
        },
        "notes": ["hair: nothing holds it"],
    }
    record = run_stage(tmp_path, stage_of("83_cloth"), lambda folder: StageOutput(_checks(found), numbers))
    section = cloth_section(record)
    rows = {row[0]: row[1:] for row in section.tables[0].rows}
    assert rows[PART][0] == "simulated" and "+-" in rows[PART][5]
    assert rows["outer"][0] == "left to the field" and rows["outer"][2:6] == ("-", "-", "-", "-")
    assert "hair: nothing holds it" in section.text
    assert [check.name for check in section.checks] == [
        *(
            f"{PART} simulated in training frames: {what}"
            for what in ("longest edge", "longest drawn edge", "inside the body")
        ),
        f"{PART}: wrong outline with it simulated",
    ]
    assert float(rows[PART][7]) == pytest.approx(found.calibrations[0].quality.longest, abs=0.006)
