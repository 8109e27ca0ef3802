"""Errors for the user's input: what was expected, what was received, what to do."""

from __future__ import annotations


class InputError(ValueError):
    """Input that cannot be used. Raised before work starts; nothing has been written.

    Args:
        subject: what is wrong, in the user's words ("scan vertices", "file scan.ply").
        expected: what would have been accepted.
        received: what was found instead.
        remedy: what the user can do about it (optional).
    """

    def __init__(self, subject: str, *, expected: str, received: str, remedy: str = "") -> None:
        self.subject, self.expected, self.received, self.remedy = subject, expected, received, remedy
        message = f"{subject}: expected {expected}, received {received}."
        super().__init__(f"{message} {remedy[:1].upper()}{remedy[1:]}." if remedy else message)


class GeometryWarning(UserWarning):
    """A stated repair or a doubtful quantity: the result is usable, the user should look."""


class MissingExtraError(ImportError):
    """An optional dependency is not installed."""

    def __init__(self, package: str, *, extra: str, purpose: str) -> None:
        super().__init__(f"{purpose} needs {package}, which is not installed: pip install 'smplxpp[{extra}]'")
