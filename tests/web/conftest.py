"""An avatar to play, and a browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.web.avatars import write_avatar
from tests.web.chromium import Page


@pytest.fixture(scope="module")
def avatar(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("avatar") / "doll.avatar"
    write_avatar(path)
    return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Page]:
    with Page(tmp_path_factory.mktemp("browser")) as page:
        yield page
