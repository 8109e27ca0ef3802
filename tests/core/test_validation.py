from __future__ import annotations

import math

import pytest

from smplxpp.core import InputError, require_at_least, require_between, require_choice, require_known, require_positive


def test_what_fits_passes():
    require_at_least("x", 0, 0)
    require_between("x", 1.0, 0.0, 1.0)
    require_positive("x", math.inf, finite=False)
    require_choice("x", "a", ("a", "b"))
    require_known("x", (), ())


@pytest.mark.parametrize(
    ("check", "arguments", "words"),
    [
        (require_at_least, (-1, 0), "at least 0"),
        (require_at_least, (math.nan, 0), "nan"),
        (require_at_least, (math.inf, 0), "inf"),
        (require_between, (2, 0, 1), "at most 1"),
        (require_positive, (0,), "above 0"),
        (require_positive, (math.nan,), "nan"),
        (require_positive, (math.inf,), "inf"),
        (require_choice, ("c", ("a", "b")), "'a' or 'b'"),
        (require_known, (("a", "z"), ("a", "b")), "received z"),
    ],
)
def test_what_does_not_is_refused_in_words(check, arguments, words):
    with pytest.raises(InputError, match=words):
        check("number", *arguments)
