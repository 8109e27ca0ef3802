"""How much memory the lists of Gaussians by tile may take, and what is said where they would take more.

An entry is a Gaussian in one tile of 16 x 16 pixels. A usual scene has some ten a Gaussian; large Gaussians, many of
them, have thousands each, and would fill any memory before the first pixel is drawn.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from jaxtyping import Float32
from torch import Tensor

from smplxpp.core.errors import InputError

VARIABLE = "SMPLXPP_LIST_GIB"
"""Environment variable with the limit in GiB."""
_GIB = 1 << 30
_LEAST, _MOST = _GIB // 2, 4 * _GIB
_TILE = 16


@cache
def list_bytes() -> int:
    """Bytes that the lists may take: as the environment says, or a quarter of the free memory from 1/2 to 4 GiB.

    Looked up once: a training must not fail for what another program does meanwhile.

    Raises:
        InputError: the environment variable is not a positive number.
    """
    given = os.environ.get(VARIABLE)
    if given is None:
        return max(_LEAST, min(_MOST, _free_bytes() // 4))
    try:
        limit = float(given)
    except ValueError:
        limit = 0.0
    if not 0 < limit < 1 << 20:
        raise InputError(f"environment variable {VARIABLE}", expected="a positive number of GiB", received=repr(given))
    return int(limit * _GIB)


def too_many_entries(
    means2d: Float32[Tensor, "N 2"], radii: Float32[Tensor, "N 2"], size: tuple[int, int], most: int, entry: int
) -> InputError:
    """Make the error that says how many entries of `entry` bytes each a scene has, by its boxes, beyond `most` bytes.

    Args:
        means2d: projected centres, pixels.
        radii: half sides of their boxes, pixels; 0 where culled.
        size: width and height of the image, pixels.
    """
    seen = radii[:, 0] > 0
    sides = []
    for axis in (0, 1):
        low, high = (means2d[seen, axis] + sign * radii[seen, axis] for sign in (-1, 1))
        first, last = (edge.double().clamp(0, size[axis] - 1).div(_TILE).floor() for edge in (low, high))
        sides.append(last - first + 1)
    entries, count = int((sides[0] * sides[1]).sum()), int(seen.sum())
    return InputError(
        "Gaussians to rasterise",
        expected=f"lists of Gaussians by tile within {most / _GIB:.3g} GiB ({most // entry:,} entries)",
        received=(
            f"up to {entries:,} entries ({entries * entry / _GIB:.3g} GiB): {count:,} visible Gaussians that cover "
            f"{entries / max(count, 1):,.0f} tiles each of {size[0]} x {size[1]} pixels"
        ),
        remedy=f"make the Gaussians fewer or smaller, or the image; {VARIABLE}=GIB raises the limit",
    )


def _free_bytes() -> int:
    """Memory that this process may still take, as the system says; the least of what is known."""
    known = [_MOST * 4]
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                known.append(1024 * int(line.split()[1]))
    except OSError:
        pass  # not Linux
    try:
        known.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):
        pass  # no limit
    return min(known)
