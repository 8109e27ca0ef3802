"""Gates of an evaluation: floors of PSNR, gains over simpler models, and what pixels can say of a surface."""

from __future__ import annotations

from dataclasses import replace

import pytest

from avatar.evaluation.report import EvalReport, ModelFigures, Surfaces
from avatar.metrics.surface_quality import SurfaceQuality
from avatar.metrics.view_quality import ViewQuality
from pipelines.stages.evaluate import evaluation_checks
from smplxpp.core.checks import Check


def view(psnr: float) -> ViewQuality:
    return ViewQuality(psnr=psnr, psnr_image=psnr, ssim=0.9, psnr_head=None, ssim_head=None)


def surfaces(upper: float) -> dict[str, Surfaces]:
    mean = SurfaceQuality(1.0, 1.0, 1.0, 1.0, {"upper": SurfaceQuality(upper, upper, upper, upper)})
    return {"training": Surfaces(mean, {0: mean})}


def checks(psnr: float, *, fit: float | None = None, upper: float = 1.0, pixel: float = 0.001) -> dict[str, Check]:
    """Of a student with a PSNR in novel views and a P2S of its shirt, mm, where skinning alone has 1 mm."""
    models = {"student": ModelFigures({"novel_view": {"Cam0_0": view(psnr)}}, surfaces(upper))}
    if fit is not None:
        models["fit"] = ModelFigures({"novel_view": {"Cam0_0": view(fit)}})
    report = EvalReport("doll", None, models, skinning_alone=surfaces(1.0))
    return {check.name: check for check in evaluation_checks(report, overlap=0.99, pixel=pixel)}


@pytest.mark.parametrize(("psnr", "status"), [(24.1, "pass"), (23.9, "warn"), (19.9, "fail")])
def test_likeness_to_held_out_photographs_is_graded(psnr, status):
    assert checks(psnr)["student, novel views: PSNR of the person"].status == status


@pytest.mark.parametrize(("distance", "status"), [(0.011, "pass"), (0.02, "warn"), (0.031, "fail")])
def test_a_perceptual_distance_is_graded_by_its_metric(distance, status):
    views = {"novel_view": {"Cam0_0": replace(view(25.0), perceptual=distance)}}
    for metric, expected in (("st-lpips", {status}), ("lpips", set())):  # no limit is known for the other metric
        report = EvalReport("doll", metric, {"student": ModelFigures(views)})
        found = [c for c in evaluation_checks(report, overlap=0.99, pixel=0.001) if "of the image" in c.name]
        assert {check.status for check in found} == expected


@pytest.mark.parametrize(("detail", "status"), [(0.9, "pass"), (0.7, "warn"), (0.4, "fail"), (None, None)])
def test_a_blurred_student_is_said_so_whatever_its_decibels(detail, status):
    views = {"novel_view": {"Cam0_0": replace(view(25.0), detail=detail)}}
    report = EvalReport("doll", None, {"student": ModelFigures(views)})
    found = {check.name: check for check in evaluation_checks(report, overlap=0.99, pixel=0.001)}
    check = found.get("student, novel views: detail")
    assert (None if check is None else check.status) == status


@pytest.mark.parametrize(("gain", "status"), [(1.0, "pass"), (-0.5, "warn"), (-1.5, "fail")])
def test_a_student_that_is_no_better_than_one_frames_gaussians_is_said_so(gain, status):
    found = checks(25.0 + gain, fit=25.0)["student against one frame's Gaussians, novel views"]
    assert found.value == pytest.approx(gain) and found.status == status
    assert "student against one frame's Gaussians, novel views" not in checks(25.0)


def test_a_surface_is_held_to_skinning_as_finely_as_pixels_show_it():
    name = "P2S of upper against skinning alone, training frames"
    assert checks(25.0, upper=1.2, pixel=0.006)[name].status == "pass"
    assert checks(25.0, upper=1.4, pixel=0.006)[name].status == "warn"
    assert checks(25.0, upper=1.6, pixel=0.006)[name].status == "fail"
    assert checks(25.0, upper=1.2, pixel=0.001)[name].status == "warn"
    # Skinning is off by more than a pixel here: photographs see that.
    assert checks(25.0, upper=1.01, pixel=0.0009)[name].status == "warn"
    # Pixels so large that the tolerance is beyond the bound.
    assert checks(25.0, upper=1.7, pixel=0.02)[name].status == "pass"
