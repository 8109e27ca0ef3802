"""Send mutations of every kind of file through its reader, and count crashes, hangs and unclear errors.

    python -m benchmarks damaged_files [--inputs 100000] [--door capture]

A mutation is of bytes, of a text's tokens, of a structure's values, or of the file itself (a folder, a pipe or a device
in its place). Each is to be read, as what it then says, or refused with an error that says what is wrong; one input may
take 4 GiB of memory and a minute.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import tyro

from benchmarks.support.results import store_results
from tests.fuzz.campaign import campaign
from tests.fuzz.doors import doors
from tests.fuzz.examine import CLEAN, OUTCOMES, READ, Findings


@dataclass(frozen=True)
class DamagedFiles:
    """Read damaged files; the table is stored where every door was tried.

    Attributes:
        inputs: how many a door.
        first: the first seed; the same seed is the same input.
        door: doors alone whose names contain this.
        jobs: doors at once.
    """

    inputs: int = 1000
    first: int = 0
    door: str = ""
    jobs: int = 2

    def run(self) -> bool:
        """Print a line a door, with the place of what is neither read nor refused; true where there is nothing so."""
        names = [name for name in doors() if self.door in name]
        table: dict[str, dict[str, int]] = {}
        with ThreadPoolExecutor(self.jobs) as pool:
            for name, findings in zip(names, pool.map(self._tried, names), strict=True):
                table[name] = {"inputs": self.inputs, **{outcome: findings.counts[outcome] for outcome in OUTCOMES}}
                print(f"{name:24}", dict(findings.counts), flush=True)
                for what, text in findings.examples.items():
                    print(f"    {what}: {text.splitlines()[0]}")
        total = {key: sum(row[key] for row in table.values()) for key in ("inputs", *OUTCOMES)}
        if not self.door:
            command = f"python -m benchmarks damaged_files --inputs {self.inputs} --first {self.first}"
            store_results("damaged_files", command, {**table, "all": total})
        return total["inputs"] == total[READ] + total[CLEAN]

    def _tried(self, name: str) -> Findings:
        return campaign(name, self.inputs, first=self.first)


if __name__ == "__main__":
    sys.exit(0 if tyro.cli(DamagedFiles, prog="python -m benchmarks damaged_files").run() else 1)
