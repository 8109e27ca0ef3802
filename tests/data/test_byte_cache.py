"""What is kept is what was made, within the bound, the latest used last to go."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from avatar.data.byte_cache import ByteCache


def numbers(count: int, value: float = 0.0) -> tuple[torch.Tensor, ...]:
    """4 bytes each."""
    return (torch.full((count,), value),)


def test_a_thing_is_made_once():
    cache, made = ByteCache(100), []

    def make() -> tuple[torch.Tensor, ...]:
        made.append(1)
        return numbers(3, 7.0)

    first, again = cache.get("a", make), cache.get("a", make)
    assert len(made) == 1 and first[0] is again[0] and "a" in cache and "b" not in cache


def test_the_one_unused_for_longest_goes():
    cache = ByteCache(3 * 16)
    for key in "abc":
        cache.get(key, lambda: numbers(4))
    cache.get("a", lambda: numbers(4))
    cache.get("d", lambda: numbers(4))
    assert [key for key in "abcd" if key in cache] == ["a", "c", "d"]


def test_what_is_larger_than_the_bound_is_given_and_pushes_nothing_out():
    cache = ByteCache(16)
    cache.get("a", lambda: numbers(4))
    assert len(cache.get("b", lambda: numbers(5))[0]) == 5
    assert "a" in cache and "b" not in cache
    assert "c" not in cache and len(ByteCache(0).get("c", lambda: numbers(1))) == 1


def test_nothing_of_a_graph_is_kept():
    weight = torch.ones(2, requires_grad=True)
    (kept,) = ByteCache(100).get("a", lambda: (2.0 * weight,))
    assert not kept.requires_grad


@settings(max_examples=40, deadline=None)
@given(
    bound=st.integers(0, 80),
    asked=st.lists(st.tuples(st.integers(0, 5), st.integers(1, 12)), max_size=30),
)
def test_the_bound_holds_and_the_newest_stays(bound, asked):
    cache, sizes = ByteCache(bound), {}
    for key, size in asked:
        (value,) = cache.get(key, lambda size=size, key=key: numbers(size, float(key)))
        assert bool((value == float(key)).all())
        sizes[key] = 4 * len(value)
        kept = [key for key in sizes if key in cache]
        assert sum(sizes[key] for key in kept) <= bound
        assert (key in cache) == (sizes[key] <= bound)
