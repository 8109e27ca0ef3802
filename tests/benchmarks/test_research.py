"""Numbers of closed questions in docs/research.md and docs/training_choices.md are those of the stored data."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.support.results import RESULTS, ROOT

PAGE = ROOT / "docs" / "research.md"
CHOICES = ROOT / "docs" / "training_choices.md"


def section(title: str, page: Path = PAGE) -> str:
    """Return the text below a heading, on one line."""
    return " ".join(page.read_text().split(f"\n## {title}\n")[1].split("\n## ")[0].split())


def closed(name: str) -> dict:
    """Return what a closed benchmark measured."""
    return json.loads((RESULTS / "closed" / f"{name}.json").read_text())["figures"]


def test_every_question_has_its_parts():
    titles = [line[3:] for line in PAGE.read_text().splitlines() if line.startswith("## ")]
    assert len(titles) == 6
    for title in titles:
        assert all(word in section(title) for word in ("*Question.*", "*Measured.*", "*Answer.*", "results/closed/"))


def test_codes():
    found = {
        kind: {name: one["mean"] for name, one in of.items()} for kind, of in closed("frame_codes_woman_casual").items()
    }
    view, pose = found["novel_view"], found["novel_pose"]
    text = section("What codes are worth")
    assert f"({pose['null code']:.1f} to {pose['fitted code']:.1f} dB)" in text
    assert f"trained code ({view['trained code']:.1f} dB)" in text
    assert f"({view['fitted code']:.1f} dB; null code {view['null code']:.1f} dB)" in text


def test_segments():
    found = closed("segments")
    text = " ".join((ROOT / "docs" / "training_method.md").read_text().split())
    means = " and ".join(f"{seam['mean_mm']:.1f}" for seam in found["seams"])
    apart = found["split from unsplit, mm"]["mean of the worst frame"]
    assert f"seams are {means} mm on average, no frame is over {apart:.1f} mm" in text
    truth = found["skirt from the truth, mm, by 50 frames"]
    assert np.allclose(truth["split"], truth["unsplit"], atol=0.02)


def test_motion():
    text = section("What drives the field", CHOICES).replace("*", "")
    rows = {person: closed(f"motion_codes_{person}")["rows"] for person in ("talking", "woman_casual")}
    fields = {
        "field, pose": "field, pose",
        "field, history of": "field, history",
        "field, autoregressive code": "field, autoregressive",
        "field, second-order latent": "field, second order",
        "simulation": "simulated",
    }
    for words, name in fields.items():
        cells = text.split(f"| {words}")[1].split(" |")[1:3]
        for cell, (person, part) in zip(cells, (("talking", "upper"), ("woman_casual", "lower")), strict=True):
            row = rows[person][f"{name}: {part}" if name == "simulated" else name]
            assert cell.split("/")[0].strip() == f"{row[part]:.1f}"


def test_pose_and_surface():
    cloth = closed("cloth_from_pose_woman_casual")
    best = min(one["p2s_mm"] for one in cloth.values() if isinstance(one, dict) and "p2s_mm" in one)
    text = section("What a pose tells of a skirt")
    assert f"{best:.1f} mm for the best" in text and f"{cloth['skinning alone']:.1f} mm for skinning" in text
    rows = closed("held_out_poses_talking")["rows"]
    text = section("Why new poses are worse")
    own, true, skinned = (
        rows[name] for name in ("student", "its Gaussians on the true surface", "its Gaussians on skinning")
    )
    assert f"gain {true['PSNR'] - own['PSNR']:.1f} dB (shirt {own['upper']:.1f} to {true['upper']:.1f} dB)" in text
    assert f"lose {own['PSNR'] - skinned['PSNR']:.1f} dB (shirt to {skinned['upper']:.1f} dB)" in text
    assert f"{rows['LBS Gaussians']['PSNR'] - skinned['PSNR']:.1f} dB below Gaussians that were trained" in text


def test_patterns():
    rows = closed("followed_surface_patterns")["rows"]
    found = {name.split(",")[0]: row["vertexwise"] for name, row in rows.items()}
    text = section("Tracking", CHOICES).replace("*", "")
    for name in ("dots", "plaid", "stripes", "plain"):
        assert text.split(f"| {name}")[1].split("|")[3].split("/")[0].strip() == f"{found[name]:.1f}"


def test_interpolation():
    found = closed("interpolation")
    text = section("Motions between their frames")
    for motion in ("turning", "talking"):
        assert f"{found[motion]['shortest turns']['vertices, mean mm']:.2f} mm ({motion})" in text
        assert f"{found[motion]['frame before, held']['vertices, mean mm']:.1f}" in text
    flipped = [
        found[f"{motion}, hemispheres flipped"]["axis angles mixed"]["vertices, mean mm"]
        for motion in ("talking", "turning")
    ]
    assert f"{round(flipped[0], -1):.0f} to {round(flipped[1], -1):.0f} mm off" in text


@pytest.mark.parametrize("which", ["darned", "holes"])
def test_armpits(which):
    means = [person["T-pose"][f"at the patch, {which}"][0] for person in closed("darning")["people"].values()]
    assert f"{min(means):.1f} to {max(means):.1f} mm" in section("Armpits that no view shows")


def test_icp():
    rows = closed("registration_icp")["rows"]
    text = section("Is iterated closest points enough")
    for right in (True, False):
        errors = np.array([row["body_mm"] for row in rows if (row["degrees_off"] == 0) == right])
        assert f"{errors.min():.0f} to {errors.max():.0f} mm" in text
    found = json.loads((RESULTS / "scan_alone_captures.json").read_text())["figures"]["summary"]
    assert f"has {found['body_mm_median']:.1f} mm" in text
