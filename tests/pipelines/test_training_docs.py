"""The guide's table of presets says what the presets are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from avatar.models.networks.teacher import Teacher
from avatar.training.engine.optimization_task import PretrainConfig
from avatar.training.presets import TRAINING_PRESETS, TrainingPreset

_WORDS = {"mesh": "mesh", "gaussians": "Gaussians"}
GUIDE = Path(__file__).resolve().parents[2] / "docs" / "training.md"


def rows() -> list[str]:
    """The rows of the table, a column for every preset."""
    columns = [_column(preset) for preset in TRAINING_PRESETS.values()]
    return [f"| {name} | " + " | ".join(column[name] for column in columns) + " |" for name in columns[0]]


def _column(preset: TrainingPreset) -> dict[str, str]:
    network, teacher, bake, compensate = preset.networks.teacher, preset.teacher, preset.bake, preset.compensate
    with torch.device("meta"):
        millions = sum(p.numel() for p in Teacher(network).parameters()) / 1e6
    stages, before = (teacher, bake, compensate), (teacher.pretrain, bake.pretrain)
    weights = {replace(stage.weights, l2=0.0) for stage in stages}
    assert len(weights) == 1
    (weight,) = weights
    return {
        "Gaussians": f"{preset.fit.sampling.count:,}",
        "Gaussians on the head, share": f"{preset.fit.sampling.head_share:.2g}",
        "denser where photographs change": f"{preset.fit.detail:g}" if preset.fit.detail else "no",
        "rates of the fit: colours; places, pixels": f"{preset.fit.rates.dc:g}; {preset.fit.rates.offset:g}",
        "clothes held to skinning within, mm of the skin": (
            "-" if teacher.track is None else f"{1e3 * teacher.track.tight_reach:g}"
        ),
        "iterations of the fit": f"{preset.fit.iterations:,}",
        "teacher: maps in, out, pixels": f"{network.in_size}, {network.out_size}",
        "teacher: parameters, millions": f"{millions:.3g}",
        "surface tracked first": "no" if teacher.track is None else f"{teacher.track.steps} steps a frame",
        "control points of surface and field": f"{preset.control_points:,}"
        if preset.control_points
        else "all vertices",
        "surface and field move the body's own surface": "no" if preset.still_body else "yes",
        "teacher: iterations": f"{teacher.iterations:,}",
        "bake: iterations": f"{bake.iterations:,}",
        "compensation: iterations": f"{compensate.iterations:,}",
        "steps without rendering before: teacher, bake": _numbers(before, "iterations"),
        "poses in each of those steps": _numbers(before, "batch"),
        "the bake compares with": "the teacher's pictures" if bake.images == "teacher" else "photographs",
        "weights of `L_non`, `L_sem`": f"{bake.nonrigid:g}, {bake.semantic:g}",
        "labels of `L_sem` are drawn of": ("-" if not bake.semantic else f"the student's {_WORDS[bake.semantic_map]}"),
        "new poses have a regression in the field's place": "yes" if bake.regression else "no",
        "poses a step": ", ".join(str(stage.poses_per_step) for stage in stages),
        "cameras a pose": ", ".join(str(stage.views) for stage in stages),
        "rate of the networks": ", ".join(f"{stage.lr:g}" for stage in stages),
        "rate of the attributes, of the fit's": ", ".join(f"{stage.attributes:g}" for stage in stages),
        "rate of the harmonics": ", ".join(f"{stage.rates.sh:g}" if stage.attributes else "-" for stage in stages),
        "penalties of large, of far Gaussians": "; ".join(
            f"{stage.scale_penalty:g}, {stage.offset_penalty:g}" if stage.attributes else "-" for stage in stages
        ),
        "tracked clothes give normals where a capture has none": (
            "yes" if all(stage.surface_normals for stage in stages) else "no"
        ),
        "share of poses shown as new ones": f"-, {bake.null_share:g}, {compensate.null_share:g}",
        "share of the last steps whose mean is kept": ", ".join(
            f"{stage.averaged:g}" if stage.averaged else "none" for stage in stages
        ),
        "perceptual term": f"{weight.perceptual:g}" if weight.perceptual else "none",
        "opacity term": f"{weight.alpha:g}" if weight.alpha else "none",
        "squared differences of colours": ", ".join(f"{stage.weights.l2:g}" for stage in stages),
        "blend shapes start from": "the surface" if compensate.init_from_track else "zero",
        "blend shapes hold neighbours together, weight": f"{compensate.coherence:,g}" if compensate.coherence else "-",
        "jaw drives the head": "yes" if preset.blend_shapes.jaw else "no",
    }


def _numbers(pretrainings: Sequence[PretrainConfig | None], name: str) -> str:
    return ", ".join("-" if each is None else f"{getattr(each, name):,}" for each in pretrainings)


def test_the_table_is_that_of_the_presets():
    text = GUIDE.read_text()
    for preset in TRAINING_PRESETS.values():  # the rows on control points and on the body speak of both
        track = preset.teacher.track
        assert track is None or track.control_points == preset.control_points
        assert track is None or track.still_body == preset.still_body
    missing = [row for row in rows() if row not in text]
    assert not missing, "docs/training.md lacks:\n" + "\n".join(missing)
    assert "| | " + " | ".join(TRAINING_PRESETS) + " |" in text
