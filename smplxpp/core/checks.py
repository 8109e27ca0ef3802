"""Check a measured number against stated limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Check:
    """A number held against a stated gate: pass below `warn`, warn below `fail`, fail from there on.

    `warn` and `fail` are upper bounds; a gate that is a lower bound is written with `higher_is_better`.
    """

    name: str
    value: float
    unit: str
    warn: float
    fail: float
    higher_is_better: bool = False
    explanation: str = ""

    @property
    def status(self) -> str:
        """`pass`, `warn` or `fail`; a NaN fails."""
        value, warn, fail = self.value, self.warn, self.fail
        if self.higher_is_better:
            value, warn, fail = -value, -warn, -fail
        if math.isnan(value) or value > fail:
            return "fail"
        return "warn" if value > warn else "pass"

    @property
    def gate(self) -> str:
        """Return the limits of the gate as text."""
        sign = ">=" if self.higher_is_better else "<="
        if self.warn == self.fail:
            return f"{sign} {self.fail:g} {self.unit}".strip()
        return f"{sign} {self.warn:g} (fail beyond {self.fail:g}) {self.unit}".strip()

    def as_dict(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "value": self.value,
            "unit": self.unit,
            "status": self.status,
            "gate": self.gate,
            "explanation": self.explanation,
        }


@dataclass(frozen=True)
class Gate:
    """Limits of a measured number: warn and fail.

    Attributes:
        unit: of number and limits.
        warn: the number passes up to here; where higher is better, from here on.
        fail: the number fails above (below where higher is better).
        higher_is_better: the limits are lower ones.
    """

    unit: str
    warn: float
    fail: float
    higher_is_better: bool = True

    def check(self, name: str, value: float, *, explanation: str = "") -> Check:
        """Hold a number against the limits.

        Example:
            >>> Gate("mm", 1.0, 3.0, higher_is_better=False).check("distance", 2.0).status
            'warn'
        """
        return Check(name, value, self.unit, self.warn, self.fail, self.higher_is_better, explanation)


@dataclass
class StageOutput:
    """Checks and numbers of a stage, beside its data.

    Attributes:
        checks: numbers held against limits.
        numbers: what else was measured, by name; may be nested.
    """

    checks: list[Check] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)
