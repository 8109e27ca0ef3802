"""The built player is that of its sources."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from pipelines.web.page import PLAYER
from smplxpp.core.rotations import matrix_from_rotvec
from tests.web.modules import NEEDS_BUILD, TOOLS, WEB, node

NATIVE = WEB.parent / "smplxpp" / "native"
KERNELS = WEB / "src" / "native" / "kernels.wasm"


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


def test_the_built_kernels_are_those_of_their_sources():
    """Every file that is compiled is in the list that the build left, as it was then."""
    listed = dict(line.split(" ") for line in KERNELS.read_bytes().split(b"sources")[-1].decode().splitlines())
    assert {"runtime/field.cpp", "cloth/xpbd.cpp", "common/simd.hpp", "kernels.mjs"} < listed.keys()
    for name, digest in listed.items():
        path = WEB / name if name == "kernels.mjs" else NATIVE / name
        found = hashlib.sha256(path.read_bytes()).hexdigest()
        assert found == digest, f"{name} changed: npm run kernels && npm run build in web/"
        included = re.findall(r'^#include "(.+)"', path.read_text(), re.MULTILINE)
        assert name == "kernels.mjs" or set(included) <= listed.keys()


@pytest.mark.slow
@NEEDS_BUILD
@pytest.mark.skipif(find_spec("ziglang") is None, reason="no compiler for the kernels: pip install ziglang==0.17.1")
def test_a_build_of_the_kernels_gives_the_same_bytes(tmp_path):
    out = tmp_path / "kernels.wasm"
    command = ["node", str(WEB / "kernels.mjs"), str(out)]
    subprocess.run(command, check=True, capture_output=True, timeout=3600, env={**os.environ, "PYTHON": sys.executable})
    assert out.read_bytes() == KERNELS.read_bytes()


@NEEDS_BUILD
def test_digests_are_those_of_sha_256():
    lengths = [0, 1, 55, 56, 63, 64, 65, 119, 120, 128, 1000]
    found = node("const result = given.map(n => m.sha256Here(new Uint8Array(n).map((_, i) => 7 * i)));", given=lengths)
    assert found == [hashlib.sha256(bytes(7 * i % 256 for i in range(n))).hexdigest() for n in lengths]


@NEEDS_BUILD
def test_joints_between_frames_take_the_short_way_round():
    """From 170 degrees to -170: through 180, not back through 0."""
    angles = np.deg2rad([[170.0, 0.0, 0.0], [-170.0, 0.0, 0.0], [-150.0, 0.0, 0.0]])
    script = """const motion = { framesPerSecond: 10, frames: 3, rotations: Float32Array.from(given.flat()),
      translation: new Float32Array(9), expression: new Float32Array(0) };
    const result = [0.05, 0.15, 0.1, 9].map(t => [...m.poseAt(motion, t).rotations]);"""
    found = matrix_from_rotvec(np.array(node(script, given=angles.tolist())))
    expected = matrix_from_rotvec(np.deg2rad([[180.0, 0, 0], [-160.0, 0, 0], [-170.0, 0, 0], [-150.0, 0, 0]]))
    np.testing.assert_allclose(found, expected, atol=1e-6)


@NEEDS_BUILD
def test_a_build_gives_the_same_bytes(tmp_path):
    out = tmp_path / "player.js"
    subprocess.run(["node", str(WEB / "build.mjs"), str(out)], check=True, capture_output=True, timeout=900)
    assert out.read_bytes() == PLAYER.read_bytes()


@pytest.mark.skipif(
    shutil.which("node") is None or not (TOOLS / "tsc").exists(), reason="no node with web/'s tools: npm ci in web/"
)
@pytest.mark.long
def test_types_fit():
    done = subprocess.run([str(TOOLS / "tsc"), "--noEmit"], cwd=WEB, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout
