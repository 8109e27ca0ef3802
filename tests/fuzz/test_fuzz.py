"""Any mutation of a valid file is read, or refused with an `InputError`: `pytest -m fuzz` tries 100,000 a door."""

from __future__ import annotations

import pytest

from tests.fuzz.campaign import campaign
from tests.fuzz.doors import doors
from tests.fuzz.examine import CLEAN, READ, Findings, examine

# A few seconds a door at most; another hundred with each longer run.
_FEW, _MANY = 40, 100_000


def check(findings: Findings, *, refuses: bool) -> None:
    """Every input was read or refused, and some were refused where the door refuses any."""
    wrong = {outcome: count for outcome, count in findings.counts.items() if outcome not in (READ, CLEAN)}
    assert not wrong, "\n".join([f"{wrong}", *(f"{what}\n{text}" for what, text in findings.examples.items())])
    assert findings.counts[CLEAN] or not refuses


@pytest.mark.parametrize("name", doors())
def test_a_few_mutations(tmp_path, name):
    check(examine(doors()[name], range(_FEW), tmp_path), refuses=doors()[name].refuses)


@pytest.mark.fuzz
@pytest.mark.parametrize("name", doors())
def test_many_mutations(name):
    findings = campaign(name, _MANY)
    check(findings, refuses=doors()[name].refuses)
    assert findings.counts[READ]


def test_the_harness_tells_what_is_wrong(tmp_path):
    """A door that breaks is found: the tests above can fail."""
    from tests.fuzz.examine import FOREIGN, MEMORY, Door

    def broken(folder):
        length = len((folder / "x.txt").read_bytes())
        if length == 11:
            return
        raise MemoryError if length % 2 else KeyError("no such key")

    door = Door("broken", lambda folder: (folder / "x.txt").write_text("hello world"), broken)
    findings = examine(door, range(60), tmp_path)
    assert findings.counts[FOREIGN] and findings.counts[MEMORY]
    assert any(what.startswith("KeyError at test_fuzz.py") for what in findings.examples)
