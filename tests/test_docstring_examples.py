"""Every public name has an example in its docstring, and the examples run."""

from __future__ import annotations

import doctest
import inspect
import warnings

import numpy as np
import pytest

import smplxpp
from smplxpp.core import Check, Gate, StageOutput, TriangleMesh, as_mesh

PUBLIC = {name: getattr(smplxpp, name) for name in smplxpp.__all__ if name != "metrics"}
BESIDE = {"Gate": Gate, "Capture.check": smplxpp.Capture.check, "TriangleMesh.to_trimesh": TriangleMesh.to_trimesh}
"""Names beside the package's own whose examples run too."""
GLOBALS = {"np": np, "smplxpp": smplxpp, "warnings": warnings, "Check": Check, "Gate": Gate, "as_mesh": as_mesh}
GLOBALS |= {"StageOutput": StageOutput, "TriangleMesh": TriangleMesh, "BuildConfig": smplxpp.BuildConfig}
GLOBALS |= {"BuildReport": smplxpp.BuildReport}
TIMES_LONG = {"Capture.check"}
"""Examples that take more than a few seconds."""


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_every_public_name_has_an_example(name: str) -> None:
    text = inspect.getdoc(PUBLIC[name]) or ""
    assert ">>>" in text, f"an example in the docstring of smplxpp.{name}"
    assert len(text.splitlines()[0].split()) > 2


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if name in TIMES_LONG else name for name in sorted(PUBLIC | BESIDE)],
)
@pytest.mark.filterwarnings("ignore::smplxpp.core.errors.GeometryWarning")
def test_the_example_runs(name: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(request.config.rootpath)
    text = inspect.getdoc((PUBLIC | BESIDE)[name]) or ""
    test = doctest.DocTestParser().get_doctest(text, dict(GLOBALS), name, None, None)
    output: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=output.append)
    assert not output, "".join(output)
