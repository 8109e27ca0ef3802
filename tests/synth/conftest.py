"""Captures of these tests are packed by deflate: LZMA takes two seconds of each."""

from __future__ import annotations

from collections.abc import Iterator
from unittest import mock

import pytest

from smplxpp.core.files.array_file import write_arrays
from smplxpp.synth import write_capture


@pytest.fixture(scope="session", autouse=True)
def packed_fast() -> Iterator[None]:
    with mock.patch.object(write_capture, "save_compact", write_arrays):
        yield
