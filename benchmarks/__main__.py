"""Lists the benchmarks, or runs one: `python -m benchmarks [NAME OPTIONS]`."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

SUPPORT = {
    "__init__",
    "__main__",
    "machine",
    "capture_truth",
    "rin23",
    "page_tables",
    "gaussian_scene",
    "detection_rooms",
    "rasterizer_peers",
}


def main() -> int:
    """Run `benchmarks.NAME`, or list the names with what each measures."""
    folder = Path(__file__).parent
    files = {path.stem: path for path in folder.glob("*.py") if path.stem not in SUPPORT}
    files |= {path.parent.name: path for path in folder.glob("*/__main__.py")}
    names = sorted(files)
    if len(sys.argv) > 1 and sys.argv[1] in names:
        name = sys.argv.pop(1)
        runpy.run_module(f"benchmarks.{name}", run_name="__main__", alter_sys=True)
        return 0
    for name in names:
        text = files[name].read_text().split('"""')[1].strip().splitlines()[0]
        print(f"{name:<16} {text}")
    return 0 if len(sys.argv) == 1 else 2


if __name__ == "__main__":
    sys.exit(main())
