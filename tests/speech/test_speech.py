"""Phonemes made by hand to a mouth that moves, on a face of ARKit's names: no engine is needed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar.speech import ARTICULATORS, Face, Phoneme, Speech, TalkConfig, articulate, talking_motion
from avatar.speech.coarticulation import Timing
from avatar.speech.face import JAW_ANGLE, MARGIN, MAX_UNOBSERVED
from avatar.speech.phonemes import CONSONANTS, VOWELS, arpabet_from_ipa, ipa_from_arpabet
from smplxpp.core import BodyParams, InputError

SIDED = ("mouthLowerDown", "mouthPress", "mouthUpperUp", "mouthSmile", "mouthStretch", "eyeBlink")
NAMES = tuple(f"{name}{side}" for name in SIDED for side in ("Left", "Right")) + (
    *("jawOpen", "mouthRollLower", "mouthRollUpper", "mouthPucker", "mouthFunnel", "browInnerUp"),
)
JAW, PRESS, TUCK, ROUND = (ARTICULATORS.index(name) for name in ("jaw", "press", "tuck", "round"))


def spoken(*names: str, each: float = 0.09, start: float = 0.2) -> Speech:
    phonemes = tuple(Phoneme(name, start + k * each, start + (k + 1) * each) for k, name in enumerate(names))
    return Speech(phonemes, start + len(names) * each + 0.2)


def curves(speech: Speech, fps: float = 100.0) -> tuple[np.ndarray, np.ndarray]:
    times = np.arange(int(speech.seconds * fps) + 1) / fps
    return times, articulate(speech, times)


def still(**values) -> BodyParams:
    return replace(BodyParams.rest(betas=0, expressions=len(NAMES)), **values)


def test_every_sound_has_a_shape_within_bounds():
    _, out = curves(spoken(*sorted(VOWELS | CONSONANTS)))
    assert np.isfinite(out).all() and out.min() >= 0.0 and out.max() <= 1.0
    assert np.abs(np.diff(out, axis=0)).max() < 0.35  # in a hundredth of a second: nothing jumps


@pytest.mark.parametrize("fps", [15.0, 24.0, 30.0, 60.0])
@pytest.mark.parametrize("each", [0.015, 0.05, 0.12])
@pytest.mark.parametrize("name", ["P", "B", "M"])
def test_bilabials_close_at_any_rate_and_between_open_vowels(name, each, fps):
    speech = spoken("AA", name, "AA", each=each, start=0.2137)
    times, out = curves(speech, fps)
    closed = speech.phonemes[1]
    near = np.abs(times + Timing().lead - 0.5 * (closed.start + closed.end)) <= 0.5001 / fps + each / 2
    assert out[near, PRESS].max() > 0.999 and out[near, JAW].min() < 0.001


def test_the_lower_lip_meets_the_teeth_and_vowels_open_and_round():
    def at_middle(name: str) -> np.ndarray:
        _, out = curves(spoken(name, each=0.2))
        return out[28]

    assert at_middle("F")[TUCK] > 0.99 and at_middle("F")[JAW] < 0.2
    assert at_middle("AA")[JAW] > 0.7 > 0.5 > at_middle("IY")[JAW]
    assert at_middle("UW")[ROUND] > 0.7 > 0.1 > at_middle("IY")[ROUND]
    assert at_middle("SIL").max() < 0.01


def test_rounding_spreads_through_consonants_and_the_mouth_is_ahead_of_the_sound():
    """The lips of `stew` are round at its s already; those of `stay` are not."""
    _, stew = curves(spoken("S", "T", "UW"))
    _, stay = curves(spoken("S", "T", "EY"))
    in_t = 33  # hundredths of a second
    assert stew[in_t, ROUND] > stay[in_t, ROUND] + 0.1
    times, out = curves(spoken("AA", each=0.3))
    half = times[np.argmax(out[:, JAW] > 0.3)]
    assert 0.08 < half < 0.2


def test_long_speech_is_the_same_as_its_beginning():
    short, long = (spoken(*(["M", "AA"] * n)) for n in (3, 30))
    motions = [talking_motion(one, Face.of(NAMES, ("jaw",)), still()) for one in (short, long)]
    frames = int(0.2 * 30 + 3 * 0.18 * 30) - 6
    for name in ("expression", "jaw_pose", "leye_pose", "body_pose"):
        a, b = (getattr(one, name)[:frames] for one in motions)
        assert np.abs(a - b).max() < 1e-2


def test_a_seed_gives_one_motion_and_another_seed_another():
    face, speech = Face.of(NAMES, ("jaw",)), spoken(*(["B", "AY"] * 20))
    one, same, other = (talking_motion(speech, face, still(), TalkConfig(seed=seed)) for seed in (3, 3, 4))
    for name, value in one.as_dict().items():
        np.testing.assert_array_equal(value, same.as_dict()[name])
    assert np.abs(one.body_pose - other.body_pose).max() > 1e-3
    np.testing.assert_array_equal(one.jaw_pose, other.jaw_pose)
    assert one.fps == 30.0 and len(one) == int(np.ceil((speech.seconds + 0.4) * 30.0)) + 1


def test_the_face_keeps_to_what_training_saw():
    rng = np.random.default_rng(0)
    expression = np.tile(rng.random(len(NAMES)) * 0.03, (5, 1))
    pressed = NAMES.index("mouthPressLeft")
    expression[:, pressed] = np.linspace(0.0, 0.2, 5)
    seen = BodyParams.concatenate(
        [still(expression=row[None], jaw_pose=np.array([[0.02, 0, 0]])) for row in expression]
    )
    face = Face.of(NAMES, ("jaw",), seen)
    np.testing.assert_allclose(face.neutral, expression.mean(axis=0))
    motion = talking_motion(spoken(*(["M", "AA", "UW"] * 9)), face, still(), TalkConfig(strength=2.0))
    assert motion.expression[:, pressed].max() == pytest.approx(0.2 + MARGIN)
    assert motion.expression.max() <= MAX_UNOBSERVED + 1e-12 and motion.expression.min() >= 0.0
    assert motion.jaw_pose[:, 0].max() <= 0.02 + JAW_ANGLE + 1e-12
    assert motion.jaw_pose[:, 0].min() == pytest.approx(0.0, abs=0.002)  # lips close though the jaw rests open
    np.testing.assert_allclose(motion.expression[-1], face.neutral, atol=0.02)


def test_a_body_without_a_jaw_joint_opens_by_its_expression():
    face = Face.of(NAMES, ("head",))
    motion = talking_motion(spoken("AA", each=0.3), face, still())
    assert motion.expression[:, NAMES.index("jawOpen")].max() > 0.5 and not motion.jaw_pose.any()


def test_eyes_blink_and_nothing_else_moves():
    speech = Speech((), 20.0)
    motion = talking_motion(speech, Face.of(NAMES, ("jaw",)), still(), TalkConfig(lively=0.0))
    lids = motion.expression[:, NAMES.index("eyeBlinkLeft")]
    starts = int((np.diff((lids > 0.5).astype(int)) == 1).sum())
    assert 3 <= starts <= 12 and lids.max() == pytest.approx(MAX_UNOBSERVED)
    others = [k for k, name in enumerate(NAMES) if not name.startswith("eyeBlink")]
    assert not motion.expression[:, others].any() and not motion.body_pose.any() and not motion.leye_pose.any()


@pytest.mark.parametrize(
    ("names", "word"),
    [(tuple(f"expression_{k:02d}" for k in range(10)), "ARKit"), (NAMES[1:], "mouthLowerDown"), ((), "ARKit")],
)
def test_a_body_without_the_names_is_refused(names, word):
    with pytest.raises(InputError, match=word):
        Face.of(names, ("jaw",))


@pytest.mark.parametrize(
    "phonemes",
    [
        (Phoneme("XX", 0.0, 0.1),),
        (Phoneme("AA1", 0.0, 0.1),),
        (Phoneme("AA", 0.1, 0.1),),
        (Phoneme("AA", 0.0, 0.3), Phoneme("B", 0.2, 0.4)),
        (Phoneme("AA", 0.9, 1.2),),
        (Phoneme("AA", float("nan"), 0.5),),
    ],
)
def test_phonemes_that_cannot_be_are_refused(phonemes):
    with pytest.raises(InputError, match="phoneme"):
        Speech(phonemes, 1.0)


@pytest.mark.parametrize(
    ("config", "word"),
    [
        (TalkConfig(fps=0.0), "frames a second"),
        (TalkConfig(strength=-1.0), "strength"),
        (TalkConfig(lively=float("nan")), "liveliness"),
    ],
)
def test_options_out_of_range_are_refused(config, word):
    with pytest.raises(InputError, match=word):
        talking_motion(spoken("AA"), Face.of(NAMES, ("jaw",)), still(), config)


def test_ipa_of_every_phoneme_reads_back():
    for name in VOWELS | CONSONANTS:
        ipa = ipa_from_arpabet([name])
        assert arpabet_from_ipa(ipa, 0)[0] == name
    assert ipa_from_arpabet(["HH", "AH0", "L", "OW1"]) == "həlˈoʊ"
