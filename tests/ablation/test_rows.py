"""What the ablation's rows are made of."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pipelines.ablation.measure import closure
from pipelines.ablation.rows import PAPER_ROWS, ROWS, ablation_rows, ablation_stages
from pipelines.runs.layout import MODEL_STAGES
from pipelines.stages.teacher import TeacherStage
from smplxpp.core.errors import InputError
from tests.dolls.tiny import tiny_preset

FRAMES = 4
"""To train on."""


def stages_of(preset=None):
    return ablation_stages(preset or tiny_preset(), training_frames=FRAMES)


def test_rows_by_name_and_by_group():
    assert tuple(ablation_rows(("paper",))) == ("naked", "no-mesh", "no-gaussians", "no-teacher", "full")
    assert tuple(ablation_rows(("mlp", "full"))) == ("full", "mlp")  # in the table's order
    assert ablation_rows(("all",)) == dict(ROWS)
    for names in (("papers",), ()):
        with pytest.raises(InputError, match="ablation rows"):
            ablation_rows(names)


def test_every_row_has_a_stage_and_every_stage_what_it_needs():
    stages = stages_of()
    for row in ROWS.values():
        made = closure(stages[row.model])
        assert made[-1] == stages[row.model] and len({stage.name for stage in made}) == len(made)
        for place, stage in enumerate(made):
            assert all(needed in made[:place] for needed in stage.needs.values())
            assert {needed.ground for needed in stage.needs.values()} <= {stage.ground}


def test_what_the_papers_rows_leave_out():
    stages = stages_of()
    names = {row: [stage.name.split("/")[1] for stage in closure(stages[PAPER_ROWS[row].model])] for row in PAPER_ROWS}
    assert names["full"] == ["gaussians", "teacher", "cloth", "bake", "full"]
    assert names["no-gaussians"] == names["full"][:-1]
    assert names["no-mesh"][:2] == names["full"][:2] and stages["no_field_bake"].student.field is None
    assert not any(isinstance(stages[name], TeacherStage) for name in names["no-teacher"])
    assert all(stages[name].ground == "naked" for name in names["naked"])
    # Nothing else differs.
    own = {"name": "ablation/no_field", "elsewhere": (), "cloth": None}  # what is simulated takes the field's place
    assert stages["no_field"] == replace(stages["full"], student=stages["no_field_bake"], **own)
    alone = stages["no_teacher_bake"]
    fields = {"name": alone.name, "elsewhere": (), "config": alone.config, "cloth": None}
    assert alone == replace(stages["bake"], source=stages["gaussians"], **fields)
    assert alone.config == replace(stages["bake"].config, iterations=alone.config.iterations)


def test_the_full_system_may_stand_in_the_run_already():
    full = closure(stages_of()["full"])
    assert [stage.elsewhere for stage in full] == [(name,) for name in MODEL_STAGES]
    others = {stage.name: stage.elsewhere for stage in stages_of().values() if stage not in full}
    assert set(others.values()) == {()}


def test_the_row_without_a_teacher_sees_as_many_photographs():
    preset = tiny_preset()
    alone = stages_of(preset)["no_teacher_bake"].config
    track, teacher, bake = preset.teacher.track, preset.teacher, preset.bake
    seen = FRAMES * track.steps * track.views + teacher.iterations * teacher.views + bake.iterations * bake.views
    assert seen <= alone.iterations * alone.views < seen + alone.views
    # A preset like the paper's: its own bake.
    paper = replace(preset, teacher=replace(teacher, track=None))
    assert stages_of(paper)["no_teacher_bake"].config == paper.bake


def test_the_null_code_is_trained_only_where_the_preset_does_not():
    preset = tiny_preset()
    stages = stages_of(preset)
    assert stages["null_code"] is stages["full"]
    without = stages_of(replace(preset, bake=replace(preset.bake, null_share=0.0)))
    assert without["null_code_bake"].config.null_share > 0 and without["bake"].config.null_share == 0


def test_tracking_is_left_out_of_the_row_that_says_so():
    preset = tiny_preset()
    stages = stages_of(preset)
    assert stages["teacher"].config.track is not None and stages["untracked_teacher"].config.track is None
    assert stages["untracked_bake"].source == stages["untracked_teacher"]
    without = stages_of(replace(preset, teacher=replace(preset.teacher, track=None)))
    assert without["untracked"] is without["full"]
