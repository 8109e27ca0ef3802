"""Forced alignment by pocketsphinx: phonemes in time of a recording whose words are given or recognised."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

import numpy as np

from avatar.speech.audio_features import amplified, clear_pauses, find_pauses, speech_level
from avatar.speech.lips import LipNetwork, alignment_score
from avatar.speech.phonemes import CONSONANTS, SILENCE, VOWELS, Phoneme, Speech, Word
from avatar.speech.pronunciation import EXTRA, check_text, no_words_error, phones_from_word, words_from_text
from smplxpp.core.errors import InputError
from smplxpp.core.files.sound_file import Sound
from smplxpp.core.lazy import import_extra

_RATE = 16_000
# Gates on `alignment_score`, nats a row of 10 ms; `python -m benchmarks aligner_gates` measures right and wrong ones.
MIN_SCORE_OF_TEXT = 0.0
"""A given text that scores less belongs to another recording."""
MIN_SCORE_OF_WORDS = -0.35
"""Recognised words that score less are no words: some may be wrong, but most of their phonemes are right."""
MIN_ENGLISH = 0.605
"""Recognised words with a lower `Recognition.score` belong to another language, music or noise. Chosen on recordings of
people in seven languages; `python -m benchmarks aligner_gates languages` measures it."""


class NotEnglishError(InputError):
    """A recording whose recognised words do not match its sounds.

    Attributes:
        score: `Recognition.score`; -inf where no words were found.
    """

    def __init__(self, score: float) -> None:
        self.score = score
        shown = f"words that match its sounds by {score:.2f}; {MIN_ENGLISH:g} and more in English"
        super().__init__(
            "sound",
            expected="words of English",
            received=shown if np.isfinite(score) else "none that the recogniser knows",
            remedy="music, noise or another language: give its words as --text, or --hear sounds, which follows any "
            "language",
        )


@dataclass(frozen=True)
class Recognition:
    """Words that were recognised in a recording, whatever its language.

    Attributes:
        speech: phonemes and words.
        agreement: of the words' phonemes with the sounds, see `alignment_score`, nats a row of 10 ms.
        confidence: mean posterior probability of the words among all that the recogniser considered, by duration.
    """

    speech: Speech
    agreement: float
    confidence: float

    @property
    def score(self) -> float:
        """The evidence for English: the confidence and a quarter of the agreement, less for a word or two.

        Other languages have words that agree with the sounds by chance, between which the recogniser cannot choose; or
        few words that it is sure of and that do not agree.
        """
        seconds = sum(one.end - one.start for one in self.speech.words)
        # Weight of the agreement, nats a row, beside the words' probability.
        agreement = 0.25
        # Seconds; over the length of the words it is what a short recording scores less, as chance varies more.
        short = 0.12
        return self.confidence + agreement * self.agreement - short / max(seconds, 0.1)

    @property
    def english(self) -> bool:
        """Whether the recording sounds like English."""
        return self.score >= MIN_ENGLISH


def aligner_installed() -> bool:
    """Return whether the recogniser, pocketsphinx, is installed."""
    return find_spec("pocketsphinx") is not None


def load_recogniser() -> Any:
    """Return pocketsphinx's `Decoder` of English, to share between several calls of `align`.

    Raises:
        MissingExtraError: pocketsphinx is not installed.
    """
    pocketsphinx = import_extra("pocketsphinx", extra=EXTRA, purpose="phonemes of a recording")
    return pocketsphinx.Decoder(samprate=float(_RATE), loglevel="FATAL")


def align(sound: Sound, text: str | None = None, *, recogniser: Any | None = None) -> Speech:
    """Return the phonemes of a recording of English by forced alignment.

    Words, given or recognised, are accepted if the recogniser can align them and their phonemes match those that the
    network of `avatar.speech.lips` recognises at their times (`alignment_score`). Without this check, tones and other
    languages would be recognised as English words.

    Args:
        sound: the recording.
        text: its words; None: they are recognised.
        recogniser: of `load_recogniser`; None: loaded for this call, which takes a second.

    Raises:
        MissingExtraError: pocketsphinx is not installed.
        InputError: silence, a text without English words or of another recording, more than 20 minutes;
            `NotEnglishError`: a recording without words or of another language.
    """
    if text is None:
        found = recognise(sound, recogniser=recogniser)
        if not found.english:
            raise NotEnglishError(found.score)
        return found.speech
    speech_level(sound)
    decoder = load_recogniser() if recogniser is None else recogniser
    aligned = _align_words(decoder, sound, _checked_words(text))
    if aligned is None or alignment_score(LipNetwork.shipped()(amplified(sound)), aligned) < MIN_SCORE_OF_TEXT:
        raise _other_text()
    return _without_pauses(aligned, sound)


def recognise(sound: Sound, *, recogniser: Any | None = None) -> Recognition:
    """Recognise English words in a recording and tell how well they match its sounds.

    A recogniser of English finds English words in any language. Their phonemes then match the sounds at their times
    hardly better than at others, which the agreement measures.

    Args:
        sound: the recording.
        recogniser: of `load_recogniser`; None: loaded for this call, which takes a second.

    Raises:
        MissingExtraError: pocketsphinx is not installed.
        InputError: silence, more than 20 minutes; `NotEnglishError` where no word was found.
    """
    speech_level(sound)
    decoder = load_recogniser() if recogniser is None else recogniser
    # Recognition wants the best path through the lattice, where the language model weighs whole sentences.
    listen_for_words(decoder)
    _process(decoder, _samples(sound))
    return judge(sound, *hypothesis(decoder), recogniser=decoder)


def listen_for_words(recogniser: Any) -> None:
    """Make a recogniser that has aligned a text recognise words again, by its language model and its lattice."""
    recogniser.config["bestpath"] = True
    recogniser.activate_search()


def hypothesis(recogniser: Any) -> tuple[list[str], float]:
    """Return the words of the utterance that a recogniser has heard, and their confidence, see `Recognition`.

    Raises:
        NotEnglishError: no words.
    """
    # Fillers such as <sil> and [NOISE] are not words; numbers in brackets mark a word's alternative pronunciations.
    found = [one for one in recogniser.seg() or () if one.word[0] not in "<["]
    if not found:
        raise NotEnglishError(-np.inf)
    frames = np.array([one.end_frame - one.start_frame + 1 for one in found])
    confidence = float(np.average([one.prob for one in found], weights=frames))
    return [one.word.split("(")[0] for one in found], confidence


def judge(sound: Sound, words: list[str], confidence: float, *, recogniser: Any) -> Recognition:
    """Align recognised words with their sound and measure how well they agree.

    Args:
        sound: the recording.
        words: of `hypothesis`.
        confidence: of `hypothesis`.
        recogniser: of `load_recogniser`; `listen_for_words` makes it recognise words afterwards.

    Raises:
        NotEnglishError: words that cannot be aligned, or no better than at random.
    """
    aligned = _align_words(recogniser, sound, words)
    agreement = -np.inf if aligned is None else alignment_score(LipNetwork.shipped()(amplified(sound)), aligned)
    if aligned is None or agreement < MIN_SCORE_OF_WORDS:
        raise NotEnglishError(-np.inf)
    return Recognition(_without_pauses(aligned, sound), agreement, confidence)


def _without_pauses(aligned: Speech, sound: Sound) -> Speech:
    """Return the speech with lips that rest in the pauses of its sound."""
    speech = replace(aligned, phonemes=tuple(clear_pauses(aligned.phonemes, find_pauses(sound))))
    if not speech.spoken:  # all phonemes lay in pauses, so the words were noise
        raise NotEnglishError(-np.inf)
    return speech


def force_align(sound: Sound, text: str, recogniser: Any) -> Speech | None:
    """Align a text with a recording, whatever its score; None where the recogniser cannot align it."""
    return _align_words(recogniser, sound, _checked_words(text))


def recognised_words(sound: Sound, recogniser: Any) -> list[str]:
    """Return the English words that the recogniser finds, as its dictionary spells them.

    Raises:
        InputError: silence, no words, more than 20 minutes.
    """
    listen_for_words(recogniser)
    _process(recogniser, _samples(sound))
    return hypothesis(recogniser)[0]


def _checked_words(text: str) -> list[str]:
    words = words_from_text(check_text(text))
    if not words:
        raise no_words_error(text)
    return words


def _other_text() -> InputError:
    return InputError(
        "sound",
        expected="the words of the text",
        received="a recording of something else",
        remedy="leave out --text: the words are then recognised",
    )


def _samples(sound: Sound, noise_level: float = 0.0) -> bytes:
    """Return samples for the recogniser at a root mean square of 0.1, with white noise of a given one."""
    samples = sound.at_rate(_RATE).samples * np.float32(0.1 / speech_level(sound))
    noise = np.random.default_rng(0).normal(scale=noise_level, size=len(samples)).astype(np.float32)
    return Sound(samples + noise, _RATE).integers().tobytes()


def _process(decoder: Any, data: bytes) -> None:
    decoder.start_utt()
    decoder.process_raw(data, full_utt=True)
    decoder.end_utt()


def _align_words(decoder: Any, sound: Sound, words: list[str]) -> Speech | None:
    """Align words, then the phones in them, in two passes; None where they do not fit the sound.

    The first pass takes the best path of its search, not that through its lattice (`bestpath`): the lattice, meant for
    language models, has lost the path of many sentences that the search has found.
    """
    # Faint noise, because the stops of a synthetic voice are exact zeros, which the recogniser cannot score.
    data = _samples(sound, 1e-3)
    # Words that the recogniser does not know are added with the phones of the spelling rules.
    for word in dict.fromkeys(words):
        if decoder.lookup_word(word) is None:
            decoder.add_word(word, " ".join(one.rstrip("012") for one in phones_from_word(word)[0]), True)
    # First pass: times of the words. Second pass: times of the phones within them.
    decoder.config["bestpath"] = False
    try:
        decoder.set_align_text(" ".join(words))
        _process(decoder, data)
        decoder.set_alignment()
        _process(decoder, data)
        alignment = decoder.get_alignment()
    except RuntimeError:
        return None
    if alignment is None:
        return None
    # A frame of 10 ms is computed from a window of 25.625 ms that starts at its time, so it describes the middle of
    # that window.
    frame, window = 0.01, 0.025625  # seconds
    offset = 0.5 * (window - frame)
    out, words_in_time = [], []
    for word in alignment:
        if word.name[0] not in "<[+":
            start = min(max(word.start * frame + offset, 0.0), sound.seconds)
            end = min(start + word.duration * frame, sound.seconds)
            words_in_time.append(Word(word.name.split("(")[0], start, end))
        phones = [phone for phone in word if phone.duration > 0]
        vowels = [phone.name for phone in phones if phone.name in VOWELS]
        stresses = iter(_stresses(word.name.split("(")[0], len(vowels)))
        for phone in phones:
            known = phone.name in VOWELS | CONSONANTS
            start = phone.start * frame + offset
            stress = next(stresses) if phone.name in VOWELS else 0
            out.append(Phoneme(phone.name if known else SILENCE, start, start + phone.duration * frame, stress))
    return Speech(tuple(_clip_to_sound(out, sound.seconds)), sound.seconds, tuple(words_in_time))


def _stresses(word: str, count: int) -> list[int]:
    """Return the stress of a word's vowels by the dictionary; 0 where it has another number of vowels."""
    known = [int(one[-1]) for one in phones_from_word(word)[0] if one[-1].isdigit()]
    return known if len(known) == count else [0] * count


def _clip_to_sound(phonemes: list[Phoneme], seconds: float) -> list[Phoneme]:
    """Clip phonemes to the sound, which the first and the last frame may exceed."""
    held = [replace(one, start=max(one.start, 0.0), end=min(one.end, seconds)) for one in phonemes]
    return [one for one in held if one.end > one.start]
