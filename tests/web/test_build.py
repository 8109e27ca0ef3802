"""The built player is that of its sources."""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from pipelines.web.page import PLAYER

WEB = Path(__file__).resolve().parents[2] / "web"
TOOLS = WEB / "node_modules" / ".bin"


def digest_of_sources() -> str:
    """As `web/build.mjs` counts it: names and bytes of what the build reads."""
    files = [
        *(path for path in (WEB / "src").rglob("*") if path.is_file()),
        WEB / "build.mjs",
        WEB / "package-lock.json",
    ]
    whole = hashlib.sha256()
    for name, path in sorted((path.relative_to(WEB).as_posix(), path) for path in files):
        whole.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return whole.hexdigest()


def test_the_built_player_is_that_of_its_sources():
    first = PLAYER.read_text().splitlines()[0]
    assert "Apache-2.0" in first
    found = re.search(r"sources ([0-9a-f]{64})", first)
    assert found and found[1] == digest_of_sources(), "build it anew: npm ci && npm run build in web/"


@pytest.mark.skipif(
    shutil.which("node") is None or not (TOOLS / "esbuild").exists(), reason="no node with web/'s tools: npm ci in web/"
)
def test_a_build_gives_the_same_bytes(tmp_path):
    out = tmp_path / "player.js"
    subprocess.run(["node", str(WEB / "build.mjs"), str(out)], check=True, capture_output=True, timeout=900)
    assert out.read_bytes() == PLAYER.read_bytes()


@pytest.mark.skipif(
    shutil.which("node") is None or not (TOOLS / "tsc").exists(), reason="no node with web/'s tools: npm ci in web/"
)
def test_types_fit():
    done = subprocess.run([str(TOOLS / "tsc"), "--noEmit"], cwd=WEB, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout
