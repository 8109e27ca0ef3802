"""The C++ of the binding under the address and undefined-behaviour sanitizers."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent
NATIVE = HERE.parents[1] / "smplxpp" / "native"


@pytest.mark.slow
def test_every_function_with_awkward_sizes(tmp_path):
    compiler = shutil.which("g++") or shutil.which("clang++")
    if not compiler:
        pytest.skip("no C++ compiler")
    program = tmp_path / "driver"
    # Without OpenMP: its runtime is not instrumented, and std::thread takes its place.
    command = [compiler, "-std=gnu++17", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    command += [
        f"-I{NATIVE}",
        str(NATIVE / "gaussians" / "binding.cpp"),
        str(HERE / "binding_driver.cpp"),
        "-pthread",
        "-o",
        str(program),
    ]
    built = subprocess.run(command, capture_output=True, text=True)
    if "asan" in built.stderr or "ubsan" in built.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert built.returncode == 0, built.stderr
    done = subprocess.run([str(program)], capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout == "done\n"
