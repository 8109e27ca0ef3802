"""OpenMP's workers sleep between parallel loops, unless the environment says otherwise."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

LIBRARIES = "from smplxpp.native import native_library; native_library()"
POLICIES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")


def spins(program: str, **environment: str) -> int:
    """Return how many times a waiting worker looks before it sleeps, as OpenMP's runtime says when it is loaded."""
    own = {name: value for name, value in os.environ.items() if name not in POLICIES}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**own, "OMP_DISPLAY_ENV": "verbose", **environment},
        capture_output=True,
        text=True,
        timeout=900,
        check=True,
    )
    found = re.search(r"GOMP_SPINCOUNT = '(\d+)'", done.stderr)
    if found is None:
        pytest.skip("another OpenMP than GNU's")
    return int(found[1])


@pytest.mark.parametrize("package", ["smplxpp", "avatar", "pipelines.cli"])
@pytest.mark.long
def test_workers_sleep_once_a_package_is_imported(package):
    assert spins(f"import {package}; {LIBRARIES}") == 0


@pytest.mark.long
def test_torchs_workers_sleep_too():
    assert spins("import avatar.training.student.bake, torch; torch.ones(200_000).exp()") == 0


@pytest.mark.long
def test_what_the_environment_says_stands():
    assert spins(f"import smplxpp; {LIBRARIES}", GOMP_SPINCOUNT="77") == 77
    assert spins(f"import avatar; {LIBRARIES}", OMP_WAIT_POLICY="active") > 1_000_000
