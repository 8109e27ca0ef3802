"""Shared fixtures of the tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import shape_contracts

shape_contracts.install()  # before anything of the packages is imported

from tests import remembered  # noqa: E402 - its imports are of the packages

remembered.install()

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"


@pytest.fixture(scope="session")
def captures() -> Path:
    """The folder of ground-truth captures; tests that need it skip where it is absent."""
    path = SHARED / "captures"
    if not path.is_dir():
        pytest.skip("no ground-truth captures beside the checkout")
    return path
