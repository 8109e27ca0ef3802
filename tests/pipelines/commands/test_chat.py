"""`smplxpp chat`: what is refused before anything is loaded."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.commands.chat import Chat
from smplxpp.core.errors import InputError


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({}, "nowhere"),
        ({"port": 0}, "port"),
        ({"port": 70_000}, "port"),
        ({"seed": -1}, "seed"),
        ({"llm": "localhost"}, "llm"),
        ({"llm": "file:///etc/passwd"}, "llm"),
    ],
)
def test_what_cannot_be_is_refused_at_once(options, word):
    with pytest.raises(InputError, match=word):
        Chat(Path("nowhere"), serve=True, **options).run()


def test_the_key_comes_from_the_environment_alone(monkeypatch):
    monkeypatch.setenv("MY_KEY", "secret")
    partner = Chat(Path("nowhere"), llm="http://127.0.0.1:1/v1", key_variable="MY_KEY", model="small").partner()
    assert partner.key == "secret" and "secret" not in repr(partner) and partner.name == "small at 127.0.0.1"
