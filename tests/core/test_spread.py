from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from smplxpp.core.spread import spread, spread_inside


@given(st.integers(0, 60), st.integers(1, 70))
def test_both_keep_order_and_count(length, count):
    values = list(range(length))
    for picked in (spread(values, count), spread_inside(values, count)):
        assert picked == sorted(set(picked)) and len(picked) == min(length, count)


def test_ends_are_among_the_first_and_not_among_the_second():
    assert spread("abcdefghij", 3) == ["a", "e", "j"]
    assert spread_inside("abcdefghij", 3) == ["b", "f", "i"]
