"""Say in words what the figures of a run mean: what it can be used for, what to do next, and the terms of the page."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipelines.report.model import CheckRow, Report, Step, Use, count_statuses, worst_status
from pipelines.runs.layout import (
    COMPENSATE_STAGE,
    EVALUATE_STAGE,
    EVALUATION,
    MODEL_STAGES,
    REFINE_STAGE,
    REFINED_PARAMS,
    REGISTERED_PARAMS,
    RELIGHT_STAGE,
    SEGMENT_STAGE,
    STUDENT,
    TEMPLATE_GLB,
    TEMPLATE_STAGES,
)

_COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


@dataclass(frozen=True)
class _Purpose:
    """A use of a run, and the checks that decide it: those of these stages whose names have one of these words.

    Attributes:
        purpose: completes "can be used to".
        stages: stages whose checks count.
        words: parts of the names of the checks; empty: all that no earlier purpose has taken.
    """

    purpose: str
    stages: tuple[str, ...]
    words: tuple[str, ...] = ()


_OUT_OF_MOTION = ("40_transfer", "50_unpose", "60_assemble")
_STUDENT = (COMPENSATE_STAGE, EVALUATE_STAGE, RELIGHT_STAGE)
_AVATAR = "show its student"
_PURPOSES = (
    _Purpose("pose, animate and export it", _OUT_OF_MOTION),
    _Purpose(
        "pose, animate and export it",
        TEMPLATE_STAGES,
        ("stretch", "worn poses", "hard poses", "off their limb", "in the body", "drawn out"),
    ),
    _Purpose("measure the person on it", ("02_reconstruct", "03_locate", "05_register", *TEMPLATE_STAGES)),
    _Purpose(f"{_AVATAR} in new poses", _STUDENT, ("novel pose", "held-out poses", "held-out frames")),
    _Purpose(f"{_AVATAR} from new cameras", _STUDENT),
    _Purpose("train a student on photographs", (REFINE_STAGE, *MODEL_STAGES)),
)
"""In the order in which checks are handed out; the page shows a purpose once, where its first checks are."""


def uses_of(checks: Sequence[CheckRow]) -> tuple[Use, ...]:
    """Group the checks of a run by what they decide, and word each group.

    A student that no evaluation has measured is never called good, because training holds it against floors alone,
    which tell a broken training from a working one.

    Example:
        >>> row = CheckRow("template to scan, upper: p95", 9.0, "mm", "fail", "<= 3 mm", stage="65_validate")
        >>> use = uses_of([row])[0]
        >>> use.purpose, use.status
        ('measure the person on it', 'fail')
        >>> use.words
        'one check failed: template to scan, upper: p95 is 9 mm, the limit <= 3 mm.'
    """
    # Hand each check to the first purpose that it belongs to.
    groups: dict[str, list[CheckRow]] = {}
    for check in checks:
        found = next(
            (
                one.purpose
                for one in _PURPOSES
                if check.stage in one.stages and (not one.words or any(word in check.name for word in one.words))
            ),
            None,
        )
        if found is not None:
            groups.setdefault(found, []).append(check)
    # Word the groups in the order of the purposes.
    evaluated = any(check.stage == EVALUATE_STAGE for check in checks)
    out = []
    for purpose in dict.fromkeys(one.purpose for one in _PURPOSES):
        group = groups.get(purpose)
        if not group:
            continue
        status, words = worst_status(group), _found(group)
        if purpose.startswith(_AVATAR) and not evaluated and status == "pass":
            status, words = "warn", "it has not been measured on held-out views yet: see the next steps."
        out.append(Use(purpose, status, words))
    return tuple(out)


def verdict_of(kind: str, checks: Sequence[CheckRow], uses: Sequence[Use]) -> str:
    """Say in one sentence what a run can be used for.

    Example:
        >>> verdict_of("template", [], [Use("animate it", "pass", ""), Use("measure on it", "fail", "")])
        'This template can be used to animate it. It cannot be relied on to measure on it.'
    """
    if not checks and not uses:
        return "No checks were made"
    # Without uses (a report of another kind than a run's) the counts are all that is known.
    counts = count_statuses(checks)
    if not uses:
        plain = {"pass": "Every check passes", "warn": "Usable, with warnings", "fail": "Some checks fail"}
        return plain[worst_status(checks)]
    by_status = {status: [use.purpose for use in uses if use.status == status] for status in ("pass", "warn", "fail")}
    out = []
    if by_status["pass"]:
        out.append(f"This {kind} can be used to {_listed(by_status['pass'])}.")
    if by_status["warn"]:
        subject = "With care also" if by_status["pass"] else f"This {kind} can be used with care"
        out.append(f"{subject} to {_listed(by_status['warn'])}.")
    if by_status["fail"]:
        subject = "It" if by_status["pass"] or by_status["warn"] else f"This {kind}"
        out.append(f"{subject} cannot be relied on to {_listed(by_status['fail'])}.")
    if counts["fail"]:
        out.append(f"{_count(counts['fail'], 'check')} failed.".capitalize())
    return " ".join(out)


def next_steps(run: Path, *, capture: Path | None = None, checks: Iterable[CheckRow] = ()) -> tuple[Step, ...]:
    """List the commands that are likely to come next, with the run's own paths.

    Args:
        run: folder of a run with a finished template.
        capture: the capture that it was built from; None: a scan, or not known.
        checks: checks of the run; those that did not pass bring the command with which they are looked into.
    """
    here = shlex.quote(str(run))
    photographs = "DIR" if capture is None else shlex.quote(str(capture))
    known = [file for file in (REFINED_PARAMS, REGISTERED_PARAMS) if (run / file).is_file()]
    motion = shlex.quote(str(run / known[0])) if known else "MOTION.npz"
    bad = {check.stage for check in checks if check.status != "pass"}
    out = []
    # What did not pass comes first.
    if SEGMENT_STAGE in bad:
        out.append(Step("correct the labels by hand, then build again", f"smplxpp label {here}"))
    if bad:
        out.append(Step("look at the layers in the browser", f"smplxpp view {here}"))
    if (run / STUDENT).is_file():
        if not (run / EVALUATION).is_file():
            out.append(Step("measure the student", f"smplxpp evaluate {here} --capture {photographs}"))
        out += [
            Step("play the student in the browser", f"smplxpp web {here} --serve"),
            Step("write the student as one file", f"smplxpp export {here} --out {shlex.quote(str(run / 'me.avatar'))}"),
        ]
    else:
        film = shlex.quote(str(run / "me.mp4"))
        out += [
            Step("open the rigged character in another program", shlex.quote(str(run / TEMPLATE_GLB))),
            Step("film it in a motion", f"smplxpp animate {here} --params {motion} --out {film}"),
            Step("train an avatar on photographs", f"smplxpp train {here} --capture {photographs}"),
        ]
    return tuple(out)


GLOSSARY = {
    "bake": "the training that hands what the teacher does over to the student",
    "Chamfer": "mean distance between two surfaces, both ways",
    "compensation": "the last training of the student: blend shapes of its Gaussians",
    "determinant": "by how much skinning changes a volume: 1 leaves it, 0 flattens it, below 0 it is turned over",
    "edge stretch": "length of a mesh edge in a pose over its length at rest; p99.9 leaves out one edge in a thousand",
    "gate": "the limits of a check: pass up to the first, warn up to the second, fail beyond",
    "Gaussians": "small soft ellipsoids on the triangles of the mesh, which are drawn instead of a texture",
    "IoU": "area that two silhouettes share over the area that either covers; 1 is the same silhouette",
    "novel poses": "held-out frames seen by held-out cameras: training has seen neither",
    "novel views": "frames that were trained on, seen by held-out cameras",
    "p95": "95 % of the values are smaller; the median is p50",
    "P2S": "distance of points to a surface, mean, mm",
    "partition of unity": "the skin weights of a vertex sum to 1",
    "PSNR of the person": "likeness of a rendering and a photograph over the person's pixels, dB: 20 dB is a typical "
    "error of 26 of 255, 30 dB one of 8",
    "skin weights": "how much each joint moves a vertex",
    "SSIM": "likeness of the structure of two images; 1 is the same image",
    "st-lpips": "distance of two images as a network sees them; 0 is the same, and below 0.01 hard to tell apart",
    "student": "the small network that players run",
    "T-pose": "arms straight to the sides; the pose in which a template is stored",
    "teacher": "the large network that the student learns from",
}
"""Terms of the page with their meaning, in the order of the alphabet."""


def glossary_of(report: Report) -> dict[str, str]:
    """Return the terms that a report uses, with their meaning."""
    parts: list[str] = [report.summary, *(number.label for number in report.key_numbers)]
    parts += [f"{check.name} {check.explanation}" for check in report.checks]
    for section in report.sections:
        parts += [section.title, *section.text]
        parts += [*(one.title for one in section.histograms), *(one.title for one in section.curves)]
        parts += [f"{table.caption} {' '.join(table.header)}" for table in section.tables]
    text = " ".join(parts).casefold()
    return {term: words for term, words in GLOSSARY.items() if term.casefold() in text}


def _found(checks: Sequence[CheckRow]) -> str:
    """Word what checks found: those that failed or warned by name, with value and gate."""
    out = []
    most_named = 3
    for status, verb in (("fail", "failed"), ("warn", "warns")):
        bad = [check for check in checks if check.status == status]
        if bad:
            named = [f"{check.name} is {check.shown}, the limit {check.gate}" for check in bad[:most_named]]
            more = f"; and {len(bad) - most_named} more" if len(bad) > most_named else ""
            out.append(f"{_count(len(bad), 'check')} {verb}: {'; '.join(named)}{more}.")
    count = len(checks)
    return " ".join(out) or ("the one check passes." if count == 1 else f"all {_count(count, 'check')} pass.")


def _count(count: int, name: str) -> str:
    """Return a count in words, up to ten."""
    return f"{_COUNTS[count] if count < len(_COUNTS) else count} {name}{'' if count == 1 else 's'}"


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', to '.join(names[:-1])} and to {names[-1]}"
