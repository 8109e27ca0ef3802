"""The rasteriser compiled for other systems, where a cross compiler and an emulator are at hand, against this one."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
NATIVE = HERE.parents[1] / "smplxpp" / "native"
SYSTEMS = {
    # apt-get install g++-aarch64-linux-gnu qemu-user-static; g++-mingw-w64-x86-64 wine wine64
    "aarch64": ("aarch64-linux-gnu-g++", ("qemu-aarch64-static", "-L", "/usr/aarch64-linux-gnu")),
    "windows": ("x86_64-w64-mingw32-g++-posix", ("wine",)),
}


def drawn(compiler: str, folder: Path, runner: tuple[str, ...] = ()) -> dict[str, list[float]]:
    """Sums of what the driver's scenes draw, by their names, as a compiler's program prints them."""
    program = folder / f"driver_{compiler}.exe"
    sources = [*sorted(NATIVE.glob("gaussians/gaussian_*.cpp")), HERE / "gaussian_driver.cpp"]
    command = [compiler, "-std=gnu++17", "-O1", "-fno-math-errno", "-fno-trapping-math", "-static", f"-I{NATIVE}"]
    built = subprocess.run(
        [*command, *map(str, sources), "-pthread", "-o", str(program)], capture_output=True, text=True
    )
    assert built.returncode == 0, built.stderr
    # Wine keeps its own folder, and tells of every screen that it does not find.
    env = {**os.environ, "WINEPREFIX": str(folder / "wine"), "WINEDEBUG": "-all"}
    done = subprocess.run([*runner, str(program)], capture_output=True, text=True, timeout=900, env=env)
    assert done.returncode == 0 and done.stdout.split()[-1] == "done", done.stdout + done.stderr
    found: dict[str, list[float]] = {}
    for line in done.stdout.splitlines()[:-1]:
        name, _, number = line.partition(": ")
        found.setdefault(name, []).append(float(number))
    return found


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> dict[str, list[float]]:
    if shutil.which("g++") is None:
        pytest.skip("no g++")
    return drawn("g++", tmp_path_factory.mktemp("here"))


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS)
def test_it_draws_what_it_draws_here(here, system, tmp_path):
    compiler, runner = SYSTEMS[system]
    missing = [name for name in (compiler, runner[0]) if shutil.which(name) is None]
    if missing:
        pytest.skip(f"no {' and no '.join(missing)}")
    there = drawn(compiler, tmp_path, runner)
    assert list(there) == list(here) and len(here) == 12
    for name, sums in here.items():
        # Six digits are printed; sums of thousands of pixels differ by the order of vectors' lanes alone.
        np.testing.assert_allclose(there[name], sums, rtol=1e-4, atol=1e-3, err_msg=name)
