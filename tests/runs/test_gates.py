"""Gates: one number each, for whichever stage measures it."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.runs import gates

STAGES = Path(gates.__file__).parents[1] / "stages"


@pytest.mark.parametrize(
    ("gate", "passes", "warns", "fails"),
    [
        (gates.PSNR["novel_view"], 18.0, 17.9, 15.9),
        (gates.PSNR["novel_pose"], 17.0, 16.9, 14.9),
        (gates.LIKENESS["novel_view"], 24.0, 23.9, 19.9),
        (gates.LIKENESS["novel_pose"], 22.0, 21.9, 16.9),
        (gates.SSIM, 0.9, 0.89, 0.74),
        (gates.LOST_BY_COMPRESSION, 0.3, 0.31, 2.1),
        (gates.AGAINST_SKINNING, 1.0, 1.01, 1.6),
    ],
)
def test_a_number_is_held_against_its_gate(gate, passes, warns, fails):
    assert [gate.check("x", value).status for value in (passes, warns, fails)] == ["pass", "warn", "fail"]
    assert gate.check("x", fails, explanation="why").as_dict()["explanation"] == "why"


def test_stages_that_measure_avatars_have_no_gates_of_their_own():
    sources = {path.name: path.read_text() for path in STAGES.glob("*.py")}
    measuring = [name for name, text in sources.items() if "PSNR of the person" in text]
    assert measuring
    for name in measuring:
        assert "gates." in sources[name] and " Check(" not in sources[name], name
