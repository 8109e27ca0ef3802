"""List the benchmarks by folder, or run one: `python -m benchmarks [NAME OPTIONS]`."""

from __future__ import annotations

import ast
import runpy
import sys
from pathlib import Path

HERE = Path(__file__).parent
FOLDERS = ("speed", "accuracy", "peers", "gpu")


def commands() -> dict[str, dict[str, str]]:
    """Return the first line of every benchmark's docstring, by folder and name.

    A module is a benchmark if its docstring shows how it is run: `python -m benchmarks NAME`.
    """
    found: dict[str, dict[str, str]] = {}
    for folder in FOLDERS:
        found[folder] = {}
        for path in sorted((HERE / folder).glob("*.py")):
            name = folder if path.stem == "__main__" else path.stem
            words = ast.get_docstring(ast.parse(path.read_text())) or ""
            if f"python -m benchmarks {name}" in words:
                found[folder][name] = words.splitlines()[0]
    return found


def main() -> int:
    """Run a benchmark, or list all of them and return 2 if the given name is none of them."""
    listed = commands()
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    for folder, names in listed.items():
        if name in names:
            sys.argv.pop(1)
            module = f"benchmarks.{folder}" if name == folder else f"benchmarks.{folder}.{name}"
            runpy.run_module(module, run_name="__main__", alter_sys=True)
            return 0
    for folder, names in listed.items():
        print(f"{folder}\n" + "\n".join(f"  {one:<18} {line}" for one, line in names.items()) + "\n")
    return 0 if not name else 2


if __name__ == "__main__":
    sys.exit(main())
