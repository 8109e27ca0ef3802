"""Voice, dictionary, espeak-ng and aligner together: what is said is found again, whatever the recording is like."""

from __future__ import annotations

import shutil
import wave
from itertools import pairwise

import numpy as np
import pytest

from avatar.driving import hear
from avatar.speech import articulate
from avatar.speech.forced_alignment import NotEnglishError, align, force_align, load_recogniser
from avatar.speech.phonemes import BILABIALS, SILENCE, VOWELS
from avatar.speech.pronunciation import pronounce
from avatar.speech.voice import PiperVoice, _symbols
from benchmarks.accuracy.talking import Espeak, starts_apart
from smplxpp.core.errors import InputError
from smplxpp.core.files.sound_file import Sound, read_wave, wave_bytes
from tests.speech.conftest import TEXT


@pytest.fixture(scope="module")
def recogniser():
    return pytest.importorskip("pocketsphinx", reason="the extra talk has the aligner")


def closures(speech) -> np.ndarray:
    return np.array([0.5 * (one.start + one.end) for one in speech.spoken if one.name in BILABIALS])


@pytest.mark.long
def test_a_voice_says_a_sentence_with_its_stresses(spoken):
    names = [one.name for one in spoken.speech.spoken]
    assert [name for name in names if name in BILABIALS] == ["P", "B", "M", "M", "B", "B", "B", "M"]
    stressed = [one.name for one in spoken.speech.phonemes if one.stress == 1]
    assert stressed[:3] == ["IY", "IH", "EH"] and set(stressed) <= VOWELS
    assert 1.5 < spoken.speech.seconds < 5.0
    other = PiperVoice(threads=1)
    assert 1.3 < other.say(TEXT, slower=1.5).sound.seconds / spoken.sound.seconds < 1.7
    np.testing.assert_array_equal(other.say(TEXT).sound.samples, spoken.sound.samples)
    # A listener who interrupts does not wait for the rest.
    asked = iter([True, False])
    assert other.say("Hi. " + TEXT, wanted=lambda: next(asked)).sound.seconds < 1.0


def test_the_voice_is_quiet_where_its_phonemes_say_so(spoken):
    """Samples within the longest vowel are louder than those behind the last phoneme by far."""
    rate, samples = spoken.sound.rate, spoken.sound.samples
    vowel = max((one for one in spoken.speech.phonemes if one.name in VOWELS), key=lambda one: one.end - one.start)

    def level(start: float, end: float) -> float:
        return float(np.sqrt(np.mean(samples[int(start * rate) : int(end * rate)] ** 2)))

    last = spoken.speech.spoken[-1].end
    assert level(vowel.start, vowel.end) > 10.0 * level(last + 0.05, spoken.speech.seconds)


@pytest.mark.long
def test_what_a_voice_said_is_aligned_at_any_rate_and_in_stereo(spoken, recogniser, tmp_path):
    truth = closures(spoken.speech)
    found = align(spoken.sound, TEXT)
    assert len(closures(found)) == len(truth)
    assert np.abs(closures(found) - truth).mean() < 0.06 and np.abs(closures(found) - truth).max() < 0.12
    assert [one.name for one in found.spoken if one.stress == 1][:3] == ["IY", "IH", "EH"]
    for rate in (8_000, 48_000):
        (tmp_path / "a.wav").write_bytes(wave_bytes(spoken.sound.at_rate(rate)))
        other = closures(align(read_wave(tmp_path / "a.wav"), TEXT))
        assert np.abs(other - truth).mean() < 0.08
    both = np.repeat((spoken.sound.at_rate(44_100).samples * 32767).astype("<i2")[:, None], 2, axis=1)
    with wave.open(str(tmp_path / "b.wav"), "wb") as file:
        file.setparams((2, 2, 44_100, len(both), "NONE", ""))
        file.writeframes(both.tobytes())
    assert np.abs(closures(align(read_wave(tmp_path / "b.wav"), TEXT)) - truth).mean() < 0.06


@pytest.mark.parametrize("snr", [60.0, 20.0])
def test_lips_rest_in_a_pause_of_a_recording_with_noise(spoken, recogniser, snr):
    """A pause of .8 s between two words: no phone lies in it, and what comes behind it is found again."""
    rate, samples = spoken.sound.rate, spoken.sound.samples
    words = [k for k, one in enumerate(spoken.speech.spoken) if one.name == "B"]
    pause = spoken.speech.spoken[words[-2]].start  # ahead of "before"
    cut = round(pause * rate)
    whole = np.concatenate([samples[:cut], np.zeros(round(0.8 * rate), np.float32), samples[cut:]])
    noise = np.random.default_rng(1).normal(size=len(whole)) * np.sqrt(np.mean(samples**2)) * 10.0 ** (-snr / 20.0)
    found = align(Sound((whole + noise).astype(np.float32), rate), TEXT)
    times = np.arange(pause + 0.15, pause + 0.45, 0.02)
    assert articulate(found, times).max() < 0.05
    truth = closures(spoken.speech)
    truth[truth > pause] += 0.8
    assert len(closures(found)) == len(truth) and np.abs(closures(found) - truth).mean() < 0.05


def test_a_sound_of_the_voice_begins_with_the_pad_ahead_of_it(voice):
    """Pads were given to the sound ahead of them: words began 75 ms behind their sound. Hisses have clear edges."""
    # Not the sentence's first sounds: a frame of the voice, 12 ms, more or less there hangs on the processor.
    said = voice.say("And she saw a ship, and I see a sofa.")
    rate = said.sound.rate
    high = np.abs(np.diff(said.sound.samples, 3)).astype(np.float64)
    loud = np.convolve(high, np.ones(rate // 100) / (rate // 100), "same")
    late = []
    for before, hiss in pairwise(said.speech.spoken):
        if hiss.name in ("S", "SH") and before.name in VOWELS:
            within = loud[round((hiss.start - 0.1) * rate) : round(hiss.end * rate)]
            begins = np.flatnonzero(within[: within.argmax()] < 0.4 * within.max())[-1] / rate - 0.1
            late.append(-begins)
    assert len(late) == 4 and np.abs(late).max() < 0.03, late


@pytest.mark.long
def test_words_are_recognised_and_other_words_refused(spoken, recogniser):
    heard = align(spoken.sound)
    assert len(heard.spoken) > 20 and heard.seconds == spoken.sound.seconds
    with pytest.raises(InputError, match="words of the text"):
        align(spoken.sound, "one " * 200)


@pytest.mark.parametrize(
    "text", ["The music was loud, but the singer had a good voice.", "Can you show me where it is?"]
)
def test_a_text_through_which_the_recogniser_finds_a_way_is_refused_where_it_is_not_what_is_heard(
    spoken, recogniser, text
):
    decoder = load_recogniser()
    assert force_align(spoken.sound, TEXT, decoder) is not None
    assert force_align(spoken.sound, text, decoder) is not None
    with pytest.raises(InputError, match="words of the text"):
        align(spoken.sound, text, recogniser=decoder)


def test_a_voice_whose_stops_are_zeros_is_aligned(recogniser):
    """Two sentences that were refused: the search had no final word in a sound that ends in zeros."""
    try:
        espeak = Espeak()
    except OSError:
        pytest.skip("the library of espeak-ng is not installed")
    decoder = load_recogniser()
    for text in (
        "The young child watched a yellow bird over the garden.",
        "People may put both blue boats by the pier!",
    ):
        sound, truth = espeak.say(text, "en-gb-x-rp", 130, 30)
        found = align(sound, text, recogniser=decoder)
        assert np.abs(starts_apart(truth, found)).mean() < 0.04


def test_words_come_with_their_times(spoken, recogniser):
    """The words of a text lie where the voice said them."""
    found = align(spoken.sound, TEXT)
    assert found.transcript == TEXT.lower().rstrip(".")
    assert all(one.end <= other.start + 1e-6 for one, other in pairwise(found.words))
    storm = found.words[-1]
    truth = [one for one in spoken.speech.spoken if one.name == "S"][-1].start
    assert abs(storm.start - truth) < 0.06 and storm.end <= found.seconds


@pytest.mark.long
def test_another_language_is_said_and_followed_by_its_sounds(spoken, recogniser, tmp_path):
    """Speech played backwards has sounds and no words of English; words were laid over it without a remark."""
    backwards = Sound(spoken.sound.samples[::-1].copy(), spoken.sound.rate)
    with pytest.raises(NotEnglishError, match=r"words that match its sounds by .*--hear sounds"):
        align(backwards)
    (tmp_path / "a.wav").write_bytes(wave_bytes(backwards))
    heard = hear(audio=tmp_path / "a.wav")
    assert "does not sound like English" in heard.notes[0]
    assert not heard.speech.words and heard.speech == hear(audio=tmp_path / "a.wav", follow="sounds").speech
    # Who asks for words gets them, with a doubt.
    forced = hear(audio=tmp_path / "a.wav", follow="words")
    assert forced.speech.words and "hardly match" in forced.notes[0]
    (tmp_path / "b.wav").write_bytes(wave_bytes(spoken.sound))
    plain = hear(audio=tmp_path / "b.wav")
    assert plain.notes == [] and "umbrella before the big storm" in plain.speech.transcript


@pytest.mark.long
def test_a_quiet_recording_is_no_silence(spoken, recogniser, tmp_path):
    """Public recordings at -66 dB were refused as silence."""
    level = float(np.sqrt(np.mean(spoken.sound.samples**2)))
    quiet = Sound(spoken.sound.samples * np.float32(5e-4 / level), spoken.sound.rate)
    (tmp_path / "a.wav").write_bytes(wave_bytes(quiet))
    found = align(read_wave(tmp_path / "a.wav"), TEXT)
    truth = closures(spoken.speech)
    assert len(closures(found)) == len(truth) and np.abs(closures(found) - truth).mean() < 0.06
    assert hear(audio=tmp_path / "a.wav").notes == []


def test_silence_and_a_blip_are_refused(recogniser):
    with pytest.raises(InputError, match="silence"):
        align(Sound(np.zeros(16_000, np.float32), 16_000))
    with pytest.raises(InputError, match="seconds"):
        align(Sound(np.ones(100, np.float32), 16_000))


def test_a_text_without_an_english_word_is_not_laid_over_a_recording(spoken, recogniser):
    with pytest.raises(InputError, match="text: expected words"):
        align(spoken.sound, "Привет")


@pytest.mark.long
def test_tones_that_are_taken_for_noises_alone_are_no_speech(recogniser):
    """They gave a motion with a still mouth, and nothing was said."""
    t = np.arange(2 * 16_000) / 16_000
    swell = 1 + 0.2 * np.sign(np.sin(4 * np.pi * t))
    chord = sum(0.2 * np.sin(2 * np.pi * hertz * t * swell) for hertz in (220, 277, 330, 440))
    noise = 0.02 * np.random.default_rng(0).standard_normal(len(t))
    with pytest.raises(InputError, match="words of English"):
        align(Sound(np.clip(chord + noise, -1.0, 1.0).astype(np.float32), 16_000))


def test_sounds_that_a_voice_does_not_have_are_refused(voice):
    with pytest.raises(InputError, match="voice's language"):
        voice.read("¤ ¤")


@pytest.mark.long
def test_music_is_refused_or_heard_as_few_words(recogniser):
    """Chords with a beat: no words, or as few as a recogniser takes for them; in the sound's bounds at any rate."""
    t = np.arange(3 * 16_000) / 16_000
    chords = np.array([[220.0, 277.2, 329.6], [196.0, 246.9, 293.7], [174.6, 220.0, 261.6]])
    tone = sum(np.sin(2 * np.pi * chords[(t // 1).astype(int), k] * t) for k in range(3)) / 3
    beat = np.exp(-8.0 * (t % 0.5)) * np.random.default_rng(0).normal(size=len(t))
    try:
        heard = align(Sound((0.3 * tone + 0.1 * beat).astype(np.float32), 16_000))
    except InputError as error:
        assert "words" in str(error) or "aligned" in str(error)
    else:
        assert len(heard.spoken) < 40


@pytest.mark.skipif(shutil.which("espeak-ng") is None, reason="espeak-ng is not installed")
@pytest.mark.parametrize(
    ("text", "pauses"),
    [("It costs $3.50, not 4!", ",!"), ("Dr. Smith left at 7 p.m. on U.S. time. Why?", ".?"), ("Yes... Go.", "..")],
)
def test_espeak_breaks_at_pauses_and_not_within_numbers_titles_and_letters(text, pauses):
    ipa = pronounce(text).ipa
    assert "".join(one for one in ipa if one in ".,;:!?") == pauses
    assert "dˈɑːktɚ smˈɪθ" in ipa or "Dr" not in text


@pytest.mark.skipif(shutil.which("espeak-ng") is None, reason="espeak-ng is not installed")
def test_espeak_speaks_other_languages_and_says_which_it_does_not():
    assert pronounce("Guten Tag", language="de").ipa.startswith("ɡˈuːt")
    assert "(" not in pronounce("Das Meeting ist cool", language="de").ipa
    with pytest.raises(InputError, match="language xx"):
        pronounce("hello", language="xx")


def test_every_sign_of_a_pronunciation_is_kept_for_the_voice():
    ipa = "bˈʌʔn̩ ɬæn, t͡ʃ"
    pieces = _symbols(ipa)
    assert "".join(symbols for symbols, _ in pieces) == ipa
    assert [name for _, name in pieces if name] == ["B", "AH", "N", "L", "AE", "N", SILENCE, "T", "SH"]
