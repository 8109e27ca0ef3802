"""The page docs/benchmarks.md, made of all stored results: `python -m benchmarks.page`; `--check` compares alone."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.machine import RESULTS
from benchmarks.page_parts import PARTS, part_of
from benchmarks.page_words import DISTILLATION
from smplxpp.capture.protocols import TRACKED
from smplxpp.core.files.atomic import atomic_write_text

PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"


def _is_tracked(content: Mapping[str, Any]) -> bool:
    """Whether a result's inputs were tracked ones, by its own word."""
    figures = content["figures"]
    if not isinstance(figures, Mapping):
        return False
    return figures.get("protocol", (figures.get("inputs") or {}).get("name")) == TRACKED


def page(results: Path = RESULTS) -> str:
    """Return the page that the stored results give."""
    lines = [
        "# Benchmarks",
        "",
        "Made by `python -m benchmarks.page` from all files of `benchmarks/results/`; do not edit it. Every stored row "
        "is printed, the unfavourable ones too. `python -m benchmarks` lists what measures them.",
        "",
        "Read the conditions with every figure. All captures here are synthetic; parameters, labels and normals were "
        f"exact unless a row says `noisy`. {DISTILLATION}",
        "",
    ]
    stored = {path.stem: json.loads(path.read_text()) for path in sorted(results.glob("*.json"))}
    names = [part.name for part in PARTS if part.name in stored]
    names += [name for name in stored if name not in names]
    # What a user will see comes before what only somebody with the truth at hand can have.
    for part in map(part_of, sorted(names, key=lambda name: not _is_tracked(stored[name]))):
        content = stored[part.name]
        lines += [f"## {part.title}", "", part.conditions, "", *_origin(content), *part.lines(content["figures"])]
    return "\n".join(lines).rstrip() + "\n"


def _origin(content: Mapping[str, Any]) -> list[str]:
    """Return how, when and on what a result was measured."""
    machine = content["machine"]
    where = f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_gib']} GiB"
    return [f"`{content['command']}`, {content['date']}, {where}.", ""]


def main(arguments: list[str] | None = None) -> int:
    """Write the page; with `--check` say by the exit code alone whether it is what the results give."""
    text = page()
    if "--check" in (sys.argv[1:] if arguments is None else arguments):
        return int(not PAGE.is_file() or PAGE.read_text() != text)
    atomic_write_text(PAGE, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
