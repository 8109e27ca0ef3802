"""Report a build: its checks against limits, its numbers and times by step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from smplxpp.build.data import RestPart
from smplxpp.capture import Capture
from smplxpp.core.checks import Check, StageOutput
from smplxpp.template.template import Template


@dataclass(frozen=True, eq=False)
class BuildReport:
    """Checks and numbers of a build by step.

    Attributes:
        steps: checks and numbers by the name of the step, in the order in which they ran.
        seconds: time of each step.

    Example:
        >>> report = BuildReport({"clean": StageOutput([Check("holes", 3, "", 0, 1)])}, {"clean": 0.5})
        >>> [check.name for check in report.failed]
        ['holes']
        >>> print(report)
        fail  clean: holes, 3 (<= 0 (fail beyond 1))
    """

    steps: Mapping[str, StageOutput]
    seconds: Mapping[str, float]

    @property
    def checks(self) -> tuple[Check, ...]:
        """Return the checks of all steps of the build."""
        return tuple(check for output in self.steps.values() for check in output.checks)

    @property
    def failed(self) -> tuple[Check, ...]:
        """Return the checks that are outside of their limits."""
        return tuple(check for check in self.checks if check.status == "fail")

    @property
    def warned(self) -> tuple[Check, ...]:
        """The checks between what passes and what fails."""
        return tuple(check for check in self.checks if check.status == "warn")

    @property
    def numbers(self) -> dict[str, dict[str, Any]]:
        """What else was measured, by step and name."""
        return {name: output.numbers for name, output in self.steps.items()}

    def __str__(self) -> str:
        """Return a line for every check, the step's name first."""
        return "\n".join(
            f"{check.status}  {name}: {check.name}, {check.value:.4g} {check.unit}".rstrip() + f" ({check.gate})"
            for name, output in self.steps.items()
            for check in output.checks
        )

    def __repr__(self) -> str:
        counts = f"{len(self.checks)} checks, {len(self.failed)} failed, {len(self.warned)} warned"
        return f"BuildReport({len(self.steps)} steps in {sum(self.seconds.values()):.1f} s; {counts})"


@dataclass(frozen=True, eq=False)
class BuildResult:
    """Result of `build_template`: template, parts, report and capture.

    Attributes:
        template: the clothed body.
        parts: the loose parts by name: in the scan's pose, their weights, their vertices in the T-pose.
        report: checks, numbers and times by step.
        capture: the capture with the parameters that the build used or registered; None without a capture.

    Example:
        >>> result = smplxpp.BuildResult(template=None, parts={}, report=BuildReport({}, {}))  # as build_template does
        >>> result.report.failed, result.capture
        ((), None)
    """

    template: Template
    parts: Mapping[str, RestPart]
    report: BuildReport
    capture: Capture | None = None

    def __repr__(self) -> str:
        return f"BuildResult({self.template!r}, {self.report!r})"
