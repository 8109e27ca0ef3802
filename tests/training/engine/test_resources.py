"""What a training asks of the machine's memory."""

from __future__ import annotations

import subprocess
import sys

import pytest

CHILD = """
import resource
import torch
from avatar.training.engine.resources import keep_freed_memory

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def use():  # beyond what malloc keeps by itself in any layout of the heap
    return torch.ones(1 << 24)

def of_five():
    for _ in range(20):  # small blocks in between have found their places after two to eight uses, by the heap's start
        use()
    before = faults()
    for _ in range(5):
        use()
    return faults() - before

before = of_five()
assert keep_freed_memory()
print(before, of_five())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator alone can be told")
def test_freed_memory_is_kept_for_the_next_step():
    done = subprocess.run([sys.executable, "-c", CHILD], capture_output=True, text=True, check=True, timeout=900)
    usual, kept = map(int, done.stdout.split())
    assert kept < 1000 < usual
