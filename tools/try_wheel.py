"""Install a built wheel in an environment of its own, without a compiler on the path, and use it as a stranger would.

`python -m tools.try_wheel dist/NAME.whl` builds the embedded person's template with it; `--demo` installs the extras
`avatar`, `video` and `chat` and runs `smplxpp demo`, too. Seconds and megabytes are printed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import venv
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import tyro

ROOT = Path(__file__).resolve().parents[1]
COMPILERS = ("cc", "c++", "gcc", "g++", "clang", "clang++")
# Both orders of loading have to give one OpenMP runtime: two pools of threads wait for each other.
ONE_RUNTIME = """
import sys
from pathlib import Path
if "torch-first" in sys.argv:
    import torch
from smplxpp.native import native_library
native_library()
import torch
torch.ones(1 << 20).sum()
maps = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "libgomp" in line}
assert len(maps) == 1, maps
"""


@dataclass(frozen=True)
class TryWheel:
    """Options of the trial."""

    wheel: tyro.conf.Positional[Path]
    """Wheel to try."""
    demo: bool = False
    """Install the extras and run the demo: minutes more."""
    runs: Path | None = None
    """Folder that keeps the demo's run; by default it is deleted with the environment."""

    def run(self) -> None:
        """Install and run.

        Raises:
            subprocess.CalledProcessError: a command failed.
            SystemExit: a compiler is still on the path of the trial.
        """
        wheel = self.wheel.resolve()
        _print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB")
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            venv.create(folder / "venv", with_pip=True)
            bin_folder = folder / "venv" / "bin"
            env = {**os.environ, "PATH": str(bin_folder), "PYTHONPATH": "", "PYTHONWARNINGS": "error"}
            env.pop("VIRTUAL_ENV", None)
            if any(shutil.which(compiler, path=env["PATH"]) for compiler in COMPILERS):
                raise SystemExit("a compiler is on the path of the trial")

            def call(what: str, *command: str | Path) -> None:
                start = perf_counter()
                quiet = {**env, "PYTHONWARNINGS": ""} if "pip" in what else env
                subprocess.run([str(part) for part in command], check=True, cwd=folder, env=quiet)
                _print(f"{what}: {perf_counter() - start:.0f} s")

            # Versions are the tested ones, as far as the file of constraints names them.
            pip = (bin_folder / "pip", "install", "--quiet", "-c", ROOT / "constraints.txt")
            call("pip install of the wheel", *pip, wheel)
            _print(f"installed: {_megabytes(folder / 'venv'):.0f} MB")
            call("smplxpp --version", bin_folder / "smplxpp", "--version")
            person = next((folder / "venv").glob("lib/python*/site-packages/pipelines/person"))
            call("smplxpp build", bin_folder / "smplxpp", "build", "run", "--capture", person)
            call("smplxpp export", bin_folder / "smplxpp", "export", "run", "--out", "person.glb")
            if self.demo:
                torch = next(
                    line for line in (ROOT / "constraints.txt").read_text().split() if line.startswith("torch==")
                )
                call("pip install of torch", *pip, torch)
                call("pip install of the extras", *pip, f"{wheel}[avatar,video,chat]")
                _print(f"installed: {_megabytes(folder / 'venv'):.0f} MB")
                for order in ("torch-first", "torch-last"):
                    call(f"one OpenMP runtime, {order}", bin_folder / "python", "-c", ONE_RUNTIME, order)
                run = Path("runs") if self.runs is None else self.runs.absolute()
                call("smplxpp demo", bin_folder / "smplxpp", "demo", run / "demo")


def _print(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _megabytes(folder: Path) -> float:
    """Return the size of a folder's files."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink()) / 1e6


if __name__ == "__main__":
    tyro.cli(TryWheel, args=sys.argv[1:]).run()
