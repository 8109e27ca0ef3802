"""Curves through time that are made as they are needed: values that go from one to the next, smooth at every joint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

_State = tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]


@dataclass(frozen=True, eq=False)
class _Move:
    """A polynomial of fifth degree from a state to a value at rest; coefficients of the time since its start."""

    start: float
    end: float
    coefficients: Float64[np.ndarray, "6 n"]

    @staticmethod
    def to(target: Float64[np.ndarray, " n"], state: _State, start: float, end: float) -> _Move:
        """Minimum jerk (Flash and Hogan 1985) between boundary values of place, speed and acceleration."""
        place, speed, acceleration = state
        T = end - start
        way = target - place
        c3 = (20.0 * way - 12.0 * speed * T - 3.0 * acceleration * T**2) / (2.0 * T**3)
        c4 = (-30.0 * way + 16.0 * speed * T + 3.0 * acceleration * T**2) / (2.0 * T**4)
        c5 = (12.0 * way - 6.0 * speed * T - acceleration * T**2) / (2.0 * T**5)
        return _Move(start, end, np.stack([place, speed, 0.5 * acceleration, c3, c4, c5]))

    def state(self, times: Float64[np.ndarray, " T"]) -> list[Float64[np.ndarray, "T n"]]:
        """Place, speed and acceleration; at rest behind the end."""
        t = np.clip(times, self.start, self.end) - self.start
        moving = (times < self.end).astype(np.float64)[:, None]
        out = []
        for order in range(3):
            powers = np.zeros((len(t), 6))
            for k in range(order, 6):
                powers[:, k] = np.prod(np.arange(k - order + 1, k + 1)) * t ** (k - order)
            out.append((powers @ self.coefficients) * (moving if order else 1.0))
        return out


class Track:
    """Values in time: those at the start until the first move, the last move's target behind it.

    Args:
        value: at the start.
    """

    def __init__(self, value: Float64[np.ndarray, " n"]) -> None:
        self._first = np.asarray(value, np.float64)
        self._moves: list[_Move] = []

    @property
    def target(self) -> Float64[np.ndarray, " n"]:
        """Where the last move ends."""
        return self._at(np.array([self.end]))[0][0]

    @property
    def end(self) -> float:
        """When the last move ends, seconds."""
        return self._moves[-1].end if self._moves else 0.0

    def move(self, target: Float64[np.ndarray, " n"], start: float, end: float) -> None:
        """Go to a value from wherever the track is at `start`, at its speed; what was planned behind it is dropped."""
        assert end > start
        self.drop(start)
        state = tuple(one[0] for one in self._at(np.array([start])))
        self._moves.append(_Move.to(np.asarray(target, np.float64), state, start, end))

    def drop(self, start: float) -> None:
        """Forget the moves that begin at a time or later."""
        while self._moves and self._moves[-1].start >= start:
            self._moves.pop()

    def forget(self, before: float) -> None:
        """Forget moves that nobody asks for any more."""
        while len(self._moves) > 1 and self._moves[1].start <= before:
            self._first = self._moves.pop(0).state(np.array([np.inf]))[0][0]

    def __call__(self, times: Float64[np.ndarray, " T"]) -> Float64[np.ndarray, "T n"]:
        """Return the values at times in seconds."""
        return self._at(np.asarray(times, np.float64))[0]

    def _at(self, times: Float64[np.ndarray, " T"]) -> list[Float64[np.ndarray, "T n"]]:
        out = [np.zeros((len(times), len(self._first))) for _ in range(3)]
        out[0][:] = self._first
        which = np.searchsorted([one.start for one in self._moves], times, side="right") - 1
        for k, one in enumerate(self._moves):
            mine = which == k
            if mine.any():
                for into, value in zip(out, one.state(times[mine]), strict=True):
                    into[mine] = value
        return out


class Wandering:
    """A track that goes on for ever between values that are drawn, the same for a seed however it is asked.

    Args:
        draw: gives the next value. rest: at the start. moves, holds: least and most seconds on the way and in between.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        draw: Callable[[np.random.Generator], Float64[np.ndarray, " n"]],
        rest: Float64[np.ndarray, " n"],
        *,
        moves: tuple[float, float],
        holds: tuple[float, float],
    ) -> None:
        self._rng, self._draw, self._moves, self._holds = rng, draw, moves, holds
        self._track = Track(rest)

    def __call__(self, times: Float64[np.ndarray, " T"]) -> Float64[np.ndarray, "T n"]:
        """Return the values at ascending times in seconds."""
        while len(times) and self._track.end <= times[-1]:
            start = self._track.end + self._rng.uniform(*self._holds)
            self._track.move(self._draw(self._rng), start, start + self._rng.uniform(*self._moves))
        return self._track(times)

    def forget(self, before: float) -> None:
        """Forget what nobody asks for any more."""
        self._track.forget(before)
