"""The stage's frames in time, and the order of a conversation: answers, interruptions, silence."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from avatar.conversation.conversation import MOST_TYPED, Conversation
from avatar.conversation.frame_queue import AHEAD, LEAD_TIME, FrameQueue, Line
from smplxpp.core.errors import InputError
from smplxpp.core.files.tensor_bytes import unpack_tensors
from tests.conversation.actors import A_CHARACTER, Dancer, Hum, Script, Words, cast, doll
from tests.conversation.test_listening import sound
from tests.dolls.dancing import dance

FPS = 30


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    return doll(tmp_path_factory.mktemp("doll"))[1]


class Clock:
    def __init__(self) -> None:
        self.time = 100.0

    def __call__(self) -> float:
        return self.time


@pytest.fixture
def stage(body):
    """A stage, its clock, and the messages that it sent, unpacked."""
    clock, sent = Clock(), []
    dancer = Dancer(FPS)
    it = FrameQueue(dancer, body, lambda data: sent.append(unpack_tensors(data, subject="message")), clock)
    return it, clock, sent, dancer


def test_frames_are_ahead_and_rows_are_the_joints(stage, body):
    it, clock, sent, _ = stage
    it.keep_ahead()
    it.keep_ahead()
    (message,) = sent
    tensors, about = message
    assert about["first"] == 0 and about["fps"] == FPS and len(tensors["rows"]) == AHEAD * FPS
    joints = len(body.joint_names)
    motion = dance().frame(3)
    row = tensors["rows"][3]
    np.testing.assert_allclose(row[: 3 * joints].reshape(-1, 3), body.axis_angles(motion)[0], atol=1e-6)
    np.testing.assert_allclose(row[3 * joints :], np.r_[motion.transl[0], motion.expression[0]], atol=1e-6)
    clock.time += 0.5
    it.keep_ahead()
    assert sent[1][1]["first"] == len(tensors["rows"]) and sent[1][1]["now"] == 0.5


def test_a_sentence_begins_soon_and_the_next_behind_it(stage):
    it, clock, sent, dancer = stage
    it.keep_ahead()
    clock.time += 0.4
    for number in range(2):
        it.say(Hum().say("twenty characters it"), Line(1, number, "words"))
    talks = [frame for kind, frame, _ in dancer.asked if kind == "talk"]
    assert talks[0] == round((0.4 + LEAD_TIME) * FPS) and talks[1] == talks[0] + 20 * A_CHARACTER * FPS
    spoken = [(tensors, about) for tensors, about in sent if "sound" in tensors]
    assert [about["first"] for _, about in spoken] == talks
    assert all(len(tensors["rows"]) / FPS == 1.0 and about["text"] == "words" for tensors, about in spoken)
    assert it.speaking
    clock.time += 2.5
    assert not it.speaking


def test_who_is_hushed_goes_on_from_now(stage):
    it, clock, sent, dancer = stage
    it.say(Hum().say("x" * 100), Line(1, 0, "x"))
    clock.time += 1.0
    it.interrupt()
    assert not it.speaking and dancer.asked[-1][:2] == ("idle", round((1.0 + LEAD_TIME) * FPS))
    assert sent[-1][1]["first"] == round((1.0 + LEAD_TIME) * FPS)
    count = len(sent)
    it.interrupt()
    it.say(Hum().say("late"), Line(1, 1, "late"), lambda: False)
    assert len(sent) == count


class Page:
    """What a page would see."""

    def __init__(self) -> None:
        self.told: list[dict] = []
        self.spoken: list[dict] = []

    def show(self, data: bytes) -> None:
        tensors, about = unpack_tensors(data, subject="message")
        if "sound" in tensors:
            self.spoken.append(about)

    def kinds(self) -> list[str]:
        return [one["kind"] for one in self.told]


def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 900
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.fixture
def talk(body):
    """Make a conversation of changed parts, and its page; it is closed in the end."""
    made = []

    def make(**changes) -> tuple[Conversation, Page, list]:
        page, reports = Page(), []
        made.append(Conversation(cast(body, **changes), page.told.append, page.show, reports.append))
        return made[-1], page, reports

    yield make
    for one in made:
        one.close()


def test_an_answer_comes_sentence_by_sentence_and_its_latency_by_part(talk):
    partner = Script()
    it, page, reports = talk(partner=partner)
    it.typed("  hello \n you ")
    until(lambda: "answered" in page.kinds())
    assert [one["text"] for one in page.spoken] == ["Hello there.", "How are you?"]
    assert page.told[0] == {"kind": "heard", "text": "hello you", "turn": 1, "spoken": False}
    it.began(1, "sound")
    it.began(1, "sound")
    it.began(7, "picture")
    assert not reports
    it.began(1, "picture")
    parts = page.told[-1]["parts"]
    assert list(parts) == ["first words", "sentence", "voice", "sent", "heard", "seen"]
    assert list(parts.values()) == sorted(parts.values()) and len(reports) == 1
    it.typed("again")
    until(lambda: page.kinds().count("answered") == 2)
    assert partner.asked[1] == [("user", "hello you"), ("assistant", "Hello there. How are you?"), ("user", "again")]


def test_something_new_stops_the_old(talk):
    it, page, _ = talk(partner=Script(("One is said. ", "...", "Later.")))
    it.typed("go")
    until(lambda: page.spoken)
    it.typed("stop")
    until(lambda: "answered" in page.kinds())
    assert page.kinds().count("stopped") == 1 and page.told[page.kinds().index("stopped")]["turn"] == 1
    assert {one["turn"] for one in page.spoken} == {1, 2}
    assert "note" not in page.kinds()  # that the first answer broke off is no error


def test_who_speaks_is_heard_and_stops_the_answer(talk):
    words = Words("how are you")
    it, page, _ = talk(recogniser=words, partner=Script(["x" * 90 + ". "] * 40))
    it.typed("go")
    until(lambda: "answered" in page.kinds())  # all is sent, minutes of it are still to be said
    assert it.frames.speaking
    samples = sound(("quiet", 0.5), ("tone", 0.5), ("quiet", 1.0))
    for k in range(0, len(samples), 1024):
        it.heard(samples[k : k + 1024])
        if "listening" in page.kinds():
            assert "stopped" in page.kinds()
    until(lambda: page.kinds().count("answered") == 2)
    heard = [one for one in page.told if one["kind"] == "heard"][-1]
    assert heard["text"] == "how are you" and heard["spoken"] and words.samples > 0.5 * 16_000


def test_sound_without_words_and_signs_without_sound_are_said(talk):
    it, page, _ = talk(recogniser=Words(""), partner=Script(("Привет. ", "👍\n", "Fine.")))
    it.heard(sound(("quiet", 0.5), ("tone", 0.5), ("quiet", 1.0)))
    assert "no word" in page.told[-1]["text"]
    it.typed("hi")
    until(lambda: "answered" in page.kinds())
    assert [one["text"] for one in page.told if one["kind"] == "silent"] == ["Привет.", "👍"]
    assert [one["text"] for one in page.spoken] == ["Fine."]


def test_words_that_do_not_match_their_sounds_are_said_and_not_answered(talk):
    words = Words("a good resume bag get")
    words.other_language = 'That did not sound like English; the nearest words are "a good resume bag get".'
    it, page, _ = talk(recogniser=words)
    it.heard(sound(("quiet", 0.5), ("tone", 0.5), ("quiet", 1.0)))
    assert page.told[-1] == {"kind": "note", "text": words.other_language}
    assert not any(one["kind"] == "heard" and one["text"] for one in page.told)


def test_digits_are_not_spoken_for_longer_than_an_answer(talk, monkeypatch):
    monkeypatch.setattr("avatar.conversation.conversation._MOST_SPOKEN", 10.0)
    it, page, _ = talk(partner=Script(["7" * 100 + ". "] * 9))
    it.typed("go on")
    until(lambda: "answered" in page.kinds())
    assert len(page.spoken) == 2 and any("cut" in one.get("text", "") for one in page.told)


def test_an_endless_answer_is_cut_and_too_long_a_text_refused(talk):
    it, page, _ = talk(partner=Script(["word " * 20 + ". "] * 1000))
    it.typed("go on")
    until(lambda: "answered" in page.kinds())
    assert any("cut" in one.get("text", "") for one in page.told)
    assert sum(len(one["text"]) for one in page.spoken) <= 4000
    for text in ("", " ", "x" * (MOST_TYPED + 1)):
        with pytest.raises(InputError, match="message"):
            it.typed(text)
