"""Damaged copies of a valid file, the same ones for the same seed."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

_NUMBERS = (b"-1", b"0", b"1e999", b"nan", b"4294967295", b"9" * 400, b"1e30", b"-0.5", b"null", b"[[]]", b'"x"', b"{}")


def mutations(data: bytes, count: int, *, seed: int) -> Iterator[bytes]:
    """`count` copies of a file: bytes flipped, cut, doubled, overwritten; numbers of a text replaced by nasty ones."""
    rng = np.random.default_rng(seed)
    texts = [m.span() for m in re.finditer(rb"-?\d+(?:\.\d+)?", data)]
    for _ in range(count):
        out = bytearray(data)
        for _ in range(int(rng.integers(1, 4))):
            a, b = sorted(int(x) for x in rng.integers(0, len(out) + 1, 2))
            kind = int(rng.choice(7, p=[0.2, 0.08, 0.08, 0.15, 0.02, 0.07, 0.4]))
            if kind == 0 and a < len(out):
                out[a] ^= 1 << int(rng.integers(0, 8))
            elif kind == 1:
                del out[a : min(b, a + 40)]
            elif kind == 2:
                out[a:a] = out[a : min(b, a + 40)]
            elif kind == 3:
                out[a : a + 4] = int(rng.choice([0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x7F800000])).to_bytes(4, "little")
            elif kind == 4:
                del out[a:]
            elif kind == 5:
                out[a:a] = rng.bytes(int(rng.integers(1, 9)))
            elif texts:
                start, end = texts[int(rng.integers(len(texts)))]
                out[start:end] = _NUMBERS[int(rng.integers(len(_NUMBERS)))]
        yield bytes(out)
