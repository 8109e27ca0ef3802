"""The native library under sanitizers: its rasteriser by hostile scenes, all of it by the tests that call it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
NATIVE = ROOT / "smplxpp" / "native"
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


# Takes the library of a folder, then runs tests in this process.
_UNDER = """
import runpy, sys
from pathlib import Path
import smplxpp.native as native
folder = Path(sys.argv[1])
native._folders = lambda: [folder]
import pytest
callers, sys.argv = sys.argv[2:], ["hostile_values", "1", "30"]
runpy.run_module("tests.native.hostile_values", run_name="__main__")
options = ["-x", "-p", "no:cacheprovider", "-W", "ignore:Module already imported", "-k", "not avx and not levels"]
sys.exit(pytest.main([*options, *callers]))
"""
_CALLERS = (
    *("tests/runtime/test_player.py", "tests/rendering/test_cpu_kernels.py", "tests/cloth/test_solver.py"),
    *("tests/cloth/test_hostile.py", "tests/raster", "tests/reconstruct/test_sweep.py"),
)


@pytest.mark.slow
@pytest.mark.parametrize(("sanitizers", "runtime"), [("address,undefined", "libasan.so"), ("thread", "libtsan.so")])
def test_the_whole_library(compiler, tmp_path, sanitizers, runtime):
    if shutil.which("cmake") is None:
        pytest.skip("no cmake")
    configure = ["cmake", "-S", str(ROOT), "-B", str(tmp_path), f"-DSMPLXPP_SANITIZE={sanitizers}"]
    for command in (configure, ["cmake", "--build", str(tmp_path)]):
        built = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "CXX": compiler})
        assert built.returncode == 0, built.stdout[-2000:] + built.stderr
    # Python itself is not instrumented: the sanitizer's runtime has to come first. Its allocations are never freed.
    # So has the library of C++, whose exceptions it watches.
    found = [
        subprocess.run(
            [compiler, f"-print-file-name={name}"], capture_output=True, text=True, check=True
        ).stdout.strip()
        for name in (runtime, "libstdc++.so.6")
    ]
    env = {**os.environ, "LD_PRELOAD": " ".join(found), "OMP_NUM_THREADS": "4", "PYTHONMALLOC": "malloc"}
    env |= {"ASAN_OPTIONS": "detect_leaks=0", "TSAN_OPTIONS": "halt_on_error=1:ignore_noninstrumented_modules=1"}
    done = subprocess.run(
        [sys.executable, "-c", _UNDER, str(tmp_path), *_CALLERS], capture_output=True, text=True, cwd=ROOT, env=env
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert " passed" in done.stdout and "Sanitizer" not in done.stderr
