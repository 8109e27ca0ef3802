"""The stage of the loose clothes: which parts it takes, what it fits them to, and what it says of the others."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from avatar.data.sequence import AvatarSequence
from avatar.training.engine.session import Session
from pipelines.report.sections.cloth import cloth_section
from pipelines.runs.stage import StageOutput, run_stage
from pipelines.stages.cloth import ClothConfig, Outlines, _checks, _numbers_of, find_garments, measure_outlines
from smplxpp.capture import open_capture
from smplxpp.cloth import ClothDriver, GarmentConfig, cut_garment
from smplxpp.cloth.calibrate import CalibrationConfig, with_values
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams
from tests.cloth.persons import PART, person, standing
from tests.dolls.doll import Doll, place_camera
from tests.runs.stages import stage_of

FRAMES, FPS = 12, 15.0
COARSE = GarmentConfig(spacing=0.06, collider_spacing=0.04)
CONFIG = ClothConfig(garment=COARSE, calibration=CalibrationConfig(drags=(1.0, 4.0), pin_depths=(0.014,), blocks=2))
CAMERAS = {"Ring0": 0, "Ring1": 90, "Ring2": 180, "Held0": 40}


def pose(frame: int) -> BodyParams:
    return standing(at=(0.25 * np.sin(0.5 * frame) ** 2, 0.0, 0.0))


@pytest.fixture(scope="module")
def moved() -> np.ndarray:
    """(T, V, 3) displacements in the T-pose of a skirt that was simulated."""
    driver = ClothDriver(
        person(), [with_values(cut_garment(person(), PART, standing(), COARSE), drag=4.0, pin_depth=0.014)]
    )
    out = np.zeros((FRAMES, person().vertex_count, 3))
    for frame in range(FRAMES):
        for k in range(4):  # as fine as the stage simulates
            shape = driver.step(pose(frame - 1 + (k + 1) / 4 if frame else 0), 1 / (4 * FPS))
        out[frame, shape.vertices] = shape.share[:, None] * shape.displacements
    return out


@pytest.fixture(scope="module")
def sequence(moved, tmp_path_factory) -> AvatarSequence:
    template = person()
    surfaces = []
    for frame in range(FRAMES):
        blended = np.einsum(
            "vj,jab->vab", template.weights.dense(), template.posed_body(pose(frame)).posed_from_rest[0]
        )
        rest = template.vertices + moved[frame]
        surfaces.append(np.einsum("vij,vj->vi", blended[:, :3, :3], rest) + blended[:, :3, 3])
    cameras = {
        name: place_camera(name, angle, size=(48, 64), height=0.7, target=0.6, distance=3.0)
        for name, angle in CAMERAS.items()
    }
    doll = Doll(
        "skirt",
        template,
        cameras,
        ("Held0",),
        params=tuple(pose(frame) for frame in range(FRAMES)),
        surfaces=tuple(surfaces),
        novel_frames=(10, 11),
        supersampling=1,
    )
    capture = open_capture(doll.write_capture(tmp_path_factory.mktemp("captures") / "skirt"))
    return AvatarSequence(replace_fps(capture, FPS), template)


def replace_fps(capture, fps):
    return replace(capture, recording=replace(capture.recording, fps=fps))


def followed(moved: np.ndarray) -> SimpleNamespace:
    """A surface as a teacher has followed it through the training frames."""
    return SimpleNamespace(
        row={frame: frame for frame in range(10)}, displacements=lambda frame: torch.tensor(moved[frame]).float()
    )


def find(sequence, tmp_path, *, track=None, reference=None, config=CONFIG):
    return find_garments(sequence, reference, config, track, Session(tmp_path))


def test_a_skirt_that_swings_is_found_and_its_drag_with_it(sequence, moved, tmp_path):
    garments, found, outlines, said = find(sequence, tmp_path, track=followed(moved), reference=standing())
    assert [garment.part for garment in garments] == [PART] and said == []
    (one,) = found
    assert one.moves and one.frames == 10 and one.simulated < one.skinned
    assert outlines[PART].better and outlines[PART].views > 0


def test_a_skirt_that_follows_the_joints_is_left_to_the_field(sequence, moved, tmp_path):
    garments, (one,), outlines, _ = find(sequence, tmp_path, track=followed(0 * moved), reference=standing())
    assert garments == [] and not one.moves and outlines == {}


def test_named_parts_are_simulated_whatever_was_followed(sequence, moved, tmp_path):
    named = replace(CONFIG, parts=(PART,))
    for track in (None, followed(0 * moved)):
        garments, *_ = find(sequence, tmp_path, track=track, reference=standing(), config=named)
        assert [garment.part for garment in garments] == [PART]
    with pytest.raises(InputError, match="loose parts"):
        find(sequence, tmp_path, reference=standing(), config=replace(CONFIG, parts=("cape",)))


def test_what_cannot_be_done_is_said(sequence, moved, tmp_path):
    nothing = find(sequence, tmp_path, reference=standing())
    assert nothing[0] == [] and "named" in nothing[3][0]
    unknown = find(sequence, tmp_path, track=followed(moved))
    assert unknown[0] == [] and "pose" in unknown[3][0]
    slow = AvatarSequence(replace_fps(sequence.capture, None), person())
    timeless = find(slow, tmp_path, track=followed(moved), reference=standing())
    assert timeless[0] == [] and "frames a second" in timeless[3][0]
    wide = AvatarSequence(sequence.capture, person(tight=False))
    loose = find(wide, tmp_path, track=followed(moved), reference=standing())
    assert loose[0] == [] and PART in loose[3][0]


def test_outlines_are_of_silhouettes_against_masks(sequence):
    garment = cut_garment(person(), PART, standing(), COARSE)
    outlines = measure_outlines(sequence, garment, FPS)
    assert 0 < outlines.simulated < outlines.skinned < 0.5
    assert Outlines(0.2, 0.1, 4).better and not Outlines(0.1, 0.2, 4).better


def test_the_report_says_what_was_found_and_what_was_not(sequence, moved, tmp_path):
    garments, found, outlines, _ = find(sequence, tmp_path, track=followed(moved), reference=standing())
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
