"""The ablation: rows are what they claim to be, share what they can, and go on where they were interrupted."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.evaluation.evaluate import EvaluationConfig
from avatar.evaluation.protocol import ProtocolConfig
from avatar.models.teacher_avatar import TeacherAvatar
from pipelines.ablation import run as module
from pipelines.ablation.pieces import BakePiece, SamePiece, TeacherPiece, Workshop
from pipelines.ablation.rows import PAPER_ROWS, PRUNED_SHARE, ROWS, ablation_pieces, ablation_rows
from pipelines.ablation.run import Ablation, AblationResult, WithoutCode, ablation_table, unfinished
from smplxpp.core.errors import InputError
from tests.dolls.swaying import open_moving, template
from tests.dolls.tiny import tiny_preset

MEASURED = EvaluationConfig(
    protocol=ProtocolConfig(every=2, sets=("novel_view", "novel_pose")),
    metric="none",
    samples=0,
    speed_pictures=0,
    shown=1,
)
FRAMES = 4
"""To train on."""
SURFACE = replace(MEASURED, protocol=ProtocolConfig(every=9, sets=("novel_view",)), samples=500)
"""One frame: what can be seen of a mesh is found in many renderings."""


@pytest.fixture(scope="module")
def shop(tmp_path_factory):
    return Workshop(open_moving(tmp_path_factory.mktemp("doll") / "capture"), template())


def planned(shop: Workshop, folder, iterations: int = 3) -> Ablation:
    return Ablation(shop, ablation_pieces(tiny_preset(iterations), frame=0, training_frames=FRAMES), folder, inputs={})


@pytest.fixture(scope="module")
def finished(shop, tmp_path_factory):
    """The paper's rows, trained and measured."""
    ablation = planned(shop, tmp_path_factory.mktemp("ablation"))
    return ablation, ablation.run(PAPER_ROWS, MEASURED)


def test_rows_by_name_and_by_group():
    assert tuple(ablation_rows(("paper",))) == ("naked", "no-mesh", "no-gaussians", "no-teacher", "full")
    assert tuple(ablation_rows(("mlp", "full"))) == ("full", "mlp")  # in the table's order
    assert ablation_rows(("all",)) == dict(ROWS)
    for names in (("papers",), ()):
        with pytest.raises(InputError, match="ablation rows"):
            ablation_rows(names)


def test_every_row_has_a_piece_and_every_piece_what_it_needs(shop, tmp_path):
    ablation = planned(shop, tmp_path)
    for row in ROWS.values():
        closure = ablation.closure(row.piece)
        assert closure[-1] == row.piece and len(set(closure)) == len(closure)
        for place, name in enumerate(closure):
            assert set(ablation.pieces[name].needs) <= set(closure[:place])
            grounds = {ablation.pieces[needed].ground for needed in ablation.pieces[name].needs}
            assert grounds <= {ablation.pieces[name].ground}


def test_what_the_papers_rows_leave_out(shop, tmp_path):
    ablation = planned(shop, tmp_path)
    pieces = ablation.pieces
    closures = {name: ablation.closure(row.piece) for name, row in PAPER_ROWS.items()}
    assert closures["full"] == ["gaussians", "teacher", "bake", "full"]
    assert closures["no-gaussians"] == closures["full"][:-1]
    assert closures["no-mesh"][:2] == closures["full"][:2] and pieces["no_field_bake"].student.field is None
    assert not any(isinstance(pieces[name], TeacherPiece) for name in closures["no-teacher"])
    assert all(pieces[name].ground == "naked" for name in closures["naked"])
    # Nothing else differs.
    assert pieces["no_field"] == replace(pieces["full"], student="no_field_bake")
    alone = pieces["no_teacher_bake"]
    assert alone == replace(pieces["bake"], source="gaussians", config=alone.config)
    assert alone.config == replace(pieces["bake"].config, iterations=alone.config.iterations)
    assert pieces["naked"] == replace(pieces["full"], student="naked_bake", ground="naked")


def test_the_row_without_a_teacher_sees_as_many_photographs():
    preset = tiny_preset()
    pieces = ablation_pieces(preset, frame=0, training_frames=FRAMES)
    track, teacher, bake, alone = (
        preset.teacher.track,
        preset.teacher,
        preset.bake,
        pieces["no_teacher_bake"].config,
    )
    seen = FRAMES * track.steps * track.views + teacher.iterations * teacher.views + bake.iterations * bake.views
    assert seen <= alone.iterations * alone.views < seen + alone.views
    # A preset like the paper's: its own bake.
    paper = replace(preset, teacher=replace(teacher, track=None))
    assert ablation_pieces(paper, frame=0, training_frames=FRAMES)["no_teacher_bake"].config == paper.bake


def test_the_null_code_is_trained_only_where_the_preset_does_not(tmp_path):
    preset = tiny_preset()
    assert ablation_pieces(preset, frame=0, training_frames=FRAMES)["null_code"] == SamePiece(student="full")
    without = replace(preset, bake=replace(preset.bake, null_share=0.0))
    pieces = ablation_pieces(without, frame=0, training_frames=FRAMES)
    assert pieces["null_code_bake"].config.null_share > 0 and isinstance(pieces["bake"], BakePiece)
    assert pieces["bake"].config.null_share == 0


def test_tracking_is_left_out_of_the_row_that_says_so(tmp_path):
    preset = tiny_preset()
    pieces = ablation_pieces(preset, frame=2, training_frames=FRAMES, built_frame=2)
    assert pieces["teacher"].config.track.reference == 2 and pieces["untracked_teacher"].config.track is None
    assert pieces["untracked_bake"] == replace(pieces["bake"], source="untracked_teacher")
    without = replace(preset, teacher=replace(preset.teacher, track=None))
    assert ablation_pieces(without, frame=2, training_frames=FRAMES)["untracked"] == SamePiece(student="full")


def test_a_change_makes_anew_what_depends_on_it_and_nothing_else(shop, tmp_path):
    old = planned(shop, tmp_path)
    preset = tiny_preset()
    changed = replace(preset, bake=replace(preset.bake, lr=1e-3))
    new = Ablation(shop, ablation_pieces(changed, frame=0, training_frames=FRAMES), tmp_path, inputs={})
    for name in ("gaussians", "teacher", "naked_teacher", "outer_teacher"):
        assert new.key(name) == old.key(name)
    for name in ("bake", "full", "pruned", "no_teacher", "mlp"):
        assert new.key(name) != old.key(name)
    other = Ablation(shop, old.pieces, tmp_path, inputs={"template": "another"})
    assert other.key("gaussians") != old.key("gaussians")


def test_trained_rows_are_what_they_claim(finished, shop):
    ablation, result = finished
    assert tuple(result.rows) == tuple(PAPER_ROWS) and not result.waiting
    camera_centers, motion = torch.tensor([[0.0, 0.5, 2.0]]), shop.sequence("clothed").motion(1)
    models = {name: ablation.piece(row.piece) for name, row in PAPER_ROWS.items()}
    with torch.no_grad():
        posed = {
            name: models[name](motion, camera_centers) for name in ("no-mesh", "no-gaussians", "full", "no-teacher")
        }
    assert posed["no-mesh"].displacements is None
    assert models["no-mesh"].blend_shapes is not None
    assert models["no-gaussians"].blend_shapes is None and posed["no-gaussians"].displacements is not None
    # The compensation leaves the mesh as the bake made it.
    assert torch.equal(posed["full"].vertices, posed["no-gaussians"].vertices)
    assert not torch.equal(posed["no-teacher"].vertices, posed["full"].vertices)
    assert models["naked"].rig.template.part_names == ("body",)
    assert isinstance(ablation.piece("teacher"), TeacherAvatar)


def test_shared_pieces_are_trained_once(finished):
    ablation, _ = finished
    made = {path.parent.name for path in ablation.folder.glob("*/piece.json")}
    assert made == {
        *("gaussians", "teacher", "bake", "full", "no_field_bake", "no_field", "no_teacher_bake", "no_teacher"),
        *("naked_gaussians", "naked_teacher", "naked_bake", "naked"),
    }
    assert not list(ablation.folder.rglob("state.safetensors"))


def test_figures_of_every_row(finished):
    _, result = finished
    table = ablation_table(result)
    assert list(table.rows) == [row.title for row in PAPER_ROWS.values()]
    for title, figures in table.rows.items():
        for key in ("novel_view.psnr", "novel_pose.ssim", "megabytes", "minutes", "iterations"):
            assert np.isfinite(figures[key]), (title, key)
    full, baked = table.rows["Full"], table.rows["w/o Gau Non."]
    assert full["megabytes"] > baked["megabytes"] and full["minutes"] > baked["minutes"]
    assert full["iterations"] == baked["iterations"] + 3
    assert "w/o Mesh Non." in table.text() and r"\toprule" in table.latex() and "novel_view.psnr" in table.csv()


def test_surfaces_are_those_of_the_posed_meshes(finished):
    ablation, _ = finished
    rows = ablation_rows(("naked", "no-mesh"))
    result = ablation.run(rows, SURFACE)
    naked, still = ablation_table(result).rows.values()
    assert still["surface.training.p2s"] == result.report.skinning_alone["training"].mean.p2s
    assert still["surface.training.lower.p2s"] > 0
    assert "surface.training.lower.p2s" not in naked and naked["surface.training.p2s"] > 0
    ablation.run(rows, MEASURED)


def test_what_stands_is_not_done_again(finished, monkeypatch):
    ablation, result = finished

    def refuse(*args, **options):
        raise AssertionError("trained or measured again")

    monkeypatch.setattr(module, "evaluate_models", refuse)
    monkeypatch.setattr(module, "Session", refuse)
    again = ablation.run(PAPER_ROWS, MEASURED)
    assert again == result
    # A piece whose file is gone does not stand.
    (ablation.folder / "full" / "avatar.safetensors").rename(ablation.folder / "moved")
    assert unfinished(ablation, PAPER_ROWS, tuple(PAPER_ROWS)) == ["full"]
    (ablation.folder / "moved").rename(ablation.folder / "full" / "avatar.safetensors")


def test_a_piece_that_is_made_anew_may_be_interrupted(shop, tmp_path):
    rows = ablation_rows(("no-gaussians",))
    planned(shop, tmp_path, iterations=2).run(rows, MEASURED)
    anew = planned(shop, tmp_path, iterations=3)
    for _ in range(200):  # a step or little more a call
        result = anew.run(rows, MEASURED, max_seconds=0.05)
        if not result.waiting:
            break
    assert not result.waiting and anew.record("bake")["iterations"] >= 3


def test_an_interrupted_ablation_ends_with_the_same_weights(finished, shop, tmp_path):
    ablation, result = finished
    cut = planned(shop, tmp_path)
    rows = ablation_rows(("full",))
    calls = 0
    while (part := cut.run(rows, MEASURED, max_seconds=1e-3 if calls < 5 else np.inf)).waiting:
        assert part == AblationResult({}, ("full",))
        assert unfinished(cut, rows, part.waiting)[-1] == "full"
        calls += 1
        assert calls < 40
    assert calls >= 5
    whole, pieced = ablation.piece("full").state_dict(), cut.piece("full").state_dict()
    assert all(torch.equal(value, pieced[name]) for name, value in whole.items())
    assert part.rows["full"].report.models == result.rows["full"].report.models


def test_pictures_and_progress_are_told(shop, tmp_path):
    told: dict[str, list] = {"training": [], "measuring": [], "measured": []}
    observer = module.Observer(
        lambda name, progress: told["training"].append((name, progress.iterations)),
        lambda name, done, total: told["measuring"].append((name, done, total)),
        lambda name, evaluation: told["measured"].append((name, [view.set for view in evaluation.views])),
    )
    planned(shop, tmp_path).run(ablation_rows(("lbs",)), MEASURED, observer=observer)
    assert {name for name, _ in told["training"]} == {"gaussians", "lbs"}
    assert max(total for name, total in told["training"] if name == "lbs") == 6  # of bake and compensation together
    assert told["measuring"][-1] == ("lbs", 3, 3)
    assert told["measured"] == [("lbs", ["novel_view", "novel_pose"])]


def test_a_pruned_student_is_smaller(finished, shop):
    ablation, result = finished
    rows = ablation_rows(("pruned", "null-code"))
    both = ablation.run(rows, MEASURED)
    student = ablation.piece("pruned")
    assert len(student.blend_shapes.active) == round(PRUNED_SHARE * len(student.gaussians))
    bytes_of = {name: both.rows[name].report.models[rows[name].title].bytes for name in rows}
    assert bytes_of["pruned"] < bytes_of["null-code"]
    # The null code's row is Full, told nothing of the frame.
    full, motion = ablation.piece("full"), shop.sequence("clothed").motion(1)
    camera_centers = torch.tensor([[0.0, 0.5, 2.0]])
    with torch.no_grad():
        full.codes.codes += 1.0  # three steps leave most of them at zero
        null, own = WithoutCode(full)(motion, camera_centers), full(motion, camera_centers)
        assert torch.equal(null.vertices, full(motion.without_code(), camera_centers).vertices)
    assert not torch.equal(null.vertices, own.vertices)
    assert result.rows["full"].report.models["Full"].bytes == bytes_of["null-code"]


def test_what_is_forgotten_is_trained_again(finished, shop, tmp_path):
    ablation = planned(shop, tmp_path)
    rows = ablation_rows(("lbs",))
    ablation.run(rows, MEASURED)
    (tmp_path / "lbs" / "piece.json").write_text(json.dumps({"key": "of another"}))
    assert unfinished(ablation, rows, ("lbs",)) == ["lbs"]
    ablation.forget(rows)
    assert unfinished(ablation, rows, ("lbs",)) == ["gaussians", "lbs"]
    assert not (tmp_path / "rows" / "lbs").exists()


@pytest.mark.slow
def test_all_rows_of_the_options_and_baselines(shop, tmp_path):
    rows = ablation_rows(("options", "baselines"))
    result = planned(shop, tmp_path, iterations=2).run(rows, MEASURED)
    assert tuple(result.rows) == tuple(rows)
    assert all(np.isfinite(f["novel_view.psnr"]) for f in ablation_table(result).rows.values())
