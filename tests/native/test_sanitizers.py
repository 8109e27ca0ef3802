"""The C++ of the rasteriser under the address and undefined-behaviour sanitizers, with scenes made to break it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent
NATIVE = HERE.parents[1] / "smplxpp" / "native"
SANITIZERS = [
    "-fsanitize=address,undefined,float-cast-overflow",
    "-fno-sanitize-recover=all",
    "-fno-omit-frame-pointer",
]


@pytest.fixture(scope="module")
def compiler(tmp_path_factory) -> str:
    name = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    if not name:
        pytest.skip("no C++ compiler")
    source = tmp_path_factory.mktemp("probe") / "probe.cpp"
    source.write_text("int main() { return 0; }\n")
    program = source.with_suffix("")
    if subprocess.run([name, *SANITIZERS, str(source), "-o", str(program)], capture_output=True).returncode:
        pytest.skip("the compiler has no sanitizers")
    return name


@pytest.mark.slow
def test_gaussians_through_the_c_interface(compiler, tmp_path):
    program = tmp_path / "driver"
    sources = [str(path) for path in sorted(NATIVE.glob("gaussians/gaussian_*.cpp"))] + [
        str(HERE / "gaussian_driver.cpp")
    ]
    # Without OpenMP: its runtime is not instrumented, and std::thread takes its place.
    command = [
        compiler,
        "-std=gnu++17",
        "-O1",
        "-g",
        *SANITIZERS,
        "-march=native",
        "-fno-math-errno",
        "-fno-trapping-math",
    ]
    command += [f"-I{NATIVE}", *sources, "-pthread", "-o", str(program)]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    done = subprocess.run([str(program)], capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("done\n")
    assert "no memory" not in done.stdout
