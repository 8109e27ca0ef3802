"""A motion is told before it is used: what is in it, what is left out, and which of the usual mistakes it has."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from pipelines.commands.params import ParamsInspect
from smplxpp.body import load_body
from smplxpp.body.motion_facts import inspect_motion
from smplxpp.core import BodyParams
from smplxpp.export.motion_files import write_amass, write_bvh
from tests.body.walks import FPS, walk


def test_a_sound_motion_has_no_mistakes(tmp_path, capsys):
    walk(None).save(tmp_path / "a.npz")
    report = ParamsInspect(input=tmp_path / "a.npz").run()
    assert report["kind"] == "smplx" and report["frames"] == 46 and report["fps"] == FPS and report["up"] == "y"
    assert not report["mistakes"] and not report["left_out"]
    way = np.ptp(walk(None).transl, axis=0)
    np.testing.assert_allclose(report["ranges"]["way"], way, atol=6e-4)
    assert "46 frames, 30 a second" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: replace(p, fps=None), "no frame rate is stated: 30"),
        (lambda p: replace(p, fps=1000.0), "a rate of 1000 frames a second"),
        (lambda p: replace(p, transl=1000.0 * p.transl), "way of .* m: millimetres"),
        (lambda p: replace(p, transl=100.0 * p.transl), "way of .* m: centimetres"),
        (lambda p: replace(p, body_pose=np.degrees(p.body_pose)), "degrees, to be converted"),
        (lambda p: replace(p, global_orient=np.tile([0.5 * np.pi, 0.0, 0.0], (46, 1))), "lies along z .*--up z"),
        (lambda p: p.select([0] * 46), "nothing moves"),
        (lambda p: p.select(np.repeat(np.arange(23), 2)), "5. % of the frames repeat"),
        (lambda p: replace(p, transl=p.transl + 3.0 * (np.arange(46) > 20)[:, None]), "jumps 5.* from frame 20"),
    ],
)
def test_the_usual_mistakes_are_told(tmp_path, change, words):
    changed: BodyParams = change(walk(None))
    changed.save(tmp_path / "a.npz")
    facts = inspect_motion(tmp_path / "a.npz")
    assert any(re.search(words, one) for one in facts.mistakes), facts.mistakes


def test_axes_families_and_what_is_left_out_are_told(tmp_path):
    """An array that nobody reads, and the axis of the layout."""
    write_amass(tmp_path / "a.npz", load_body(), walk(None))
    arrays = dict(np.load(tmp_path / "a.npz")) | {"foot_contacts": np.ones((46, 4))}
    np.savez(tmp_path / "b.npz", **arrays)
    facts = inspect_motion(tmp_path / "b.npz")
    assert facts.up == "z" and facts.kind == "amass" and not facts.mistakes
    assert len(facts.left_out) == 1 and facts.left_out[0].endswith("not read in the layout amass: foot_contacts")


def test_skeletons_are_told(tmp_path):
    write_bvh(tmp_path / "a.bvh", load_body(), walk(None))
    facts = inspect_motion(tmp_path / "a.bvh")
    assert facts.unit.startswith("cm: a leg measures 86.4") and facts.up == "y"
    assert facts.skeleton["joints"]["left_hip"] == ["left_hip"] and facts.skeleton["rest"] == "rest pose"
    # A file in which no person is found says which joints it has.
    text = (tmp_path / "a.bvh").read_text()
    (tmp_path / "b.bvh").write_text(
        text[: text.index("JOINT left_hip")] + "}\nMOTION\nFrames: 1\nFrame Time: 0.1\n" + "0 " * 6
    )
    facts = inspect_motion(tmp_path / "b.bvh")
    assert facts.skeleton == {"names": ["pelvis"]} and "--joint-map" in facts.mistakes[0]
