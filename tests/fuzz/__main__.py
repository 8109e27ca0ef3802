"""Hostile inputs to every reader, by the command line: `python -m tests.fuzz --inputs 100000 --out hostile.json`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from tests.fuzz.campaign import campaign
from tests.fuzz.doors import doors
from tests.fuzz.examine import CLEAN, OUTCOMES, READ


def main() -> int:
    """Print a line a door and write the table; 1 where an input was neither read nor refused."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=1000, help="inputs a door")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--door", default="", help="doors whose names contain this")
    parser.add_argument("--out", type=Path, help="a JSON file for the table; doors that are not tried now stay in it")
    chosen = parser.parse_args()
    table = json.loads(chosen.out.read_text())["doors"] if chosen.out and chosen.out.is_file() else {}
    bad = 0
    for name in doors():
        if chosen.door not in name:
            continue
        begun = time.monotonic()
        findings = campaign(name, chosen.inputs, first=chosen.first)
        table[name] = {outcome: findings.counts[outcome] for outcome in OUTCOMES}
        seconds = time.monotonic() - begun
        sys.stdout.write(f"{name:24} {seconds:7.1f} s  {dict(findings.counts)}\n")
        for what, text in findings.examples.items():
            sys.stdout.write(f"    {what}\n        " + text.strip().replace("\n", "\n        ") + "\n")
        sys.stdout.flush()
        bad += sum(count for outcome, count in table[name].items() if outcome not in (CLEAN, READ))
        if chosen.out:
            chosen.out.write_text(json.dumps({"doors": table}, indent=1) + "\n")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
