"""Curves through time, extended on demand: minimum-jerk moves between values, with continuous acceleration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

_State = tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]


@dataclass(frozen=True, eq=False)
class _Move:
    """A quintic polynomial from a state to a value at rest, in the time since its start."""

    start: float
    end: float
    coefficients: Float64[np.ndarray, "6 n"]

    @staticmethod
    def to(target: Float64[np.ndarray, " n"], state: _State, start: float, end: float) -> _Move:
        """Solve for minimum jerk (Flash and Hogan 1985) with given position, velocity and acceleration at the start."""
        position, velocity, acceleration = state
        # x(t) = sum c_k t^k with position, velocity and acceleration given at 0 and target, 0, 0 at T: six equations.
        T = end - start
        delta = target - position
        c3 = (20.0 * delta - 12.0 * velocity * T - 3.0 * acceleration * T**2) / (2.0 * T**3)
        c4 = (-30.0 * delta + 16.0 * velocity * T + 3.0 * acceleration * T**2) / (2.0 * T**4)
        c5 = (12.0 * delta - 6.0 * velocity * T - acceleration * T**2) / (2.0 * T**5)
        return _Move(start, end, np.stack([position, velocity, 0.5 * acceleration, c3, c4, c5]))

    def state(self, times: Float64[np.ndarray, " T"]) -> list[Float64[np.ndarray, "T n"]]:
        """Return position, velocity and acceleration at times; at rest after the end."""
        t = np.clip(times, self.start, self.end) - self.start
        moving = (times < self.end).astype(np.float64)[:, None]
        out = []
        for order in range(3):
            # Derivative of t^k: k (k - 1) ... (k - order + 1) t^(k - order).
            powers = np.zeros((len(t), 6))
            for k in range(order, 6):
                powers[:, k] = np.prod(np.arange(k - order + 1, k + 1)) * t ** (k - order)
            out.append((powers @ self.coefficients) * (moving if order else 1.0))
        return out


class Track:
    """A piecewise minimum-jerk curve: constant before the first move and after the last one.

    Args:
        value: before the first move.
    """

    def __init__(self, value: Float64[np.ndarray, " n"]) -> None:
        self._first = np.asarray(value, np.float64)
        self._moves: list[_Move] = []

    @property
    def target(self) -> Float64[np.ndarray, " n"]:
        """The value at the end of the last move."""
        return self._at(np.array([self.end]))[0][0]

    @property
    def end(self) -> float:
        """The end of the last move, seconds."""
        return self._moves[-1].end if self._moves else 0.0

    def move(self, target: Float64[np.ndarray, " n"], start: float, end: float) -> None:
        """Move to a value, starting at `start` with the state there; discard moves planned for later."""
        assert end > start
        self.discard_from(start)
        # Start from position, velocity and acceleration there, so that interrupted moves continue smoothly.
        state = tuple(one[0] for one in self._at(np.array([start])))
        self._moves.append(_Move.to(np.asarray(target, np.float64), state, start, end))

    def discard_from(self, start: float) -> None:
        """Discard the moves that begin at a time or later."""
        while self._moves and self._moves[-1].start >= start:
            self._moves.pop()

    def discard_before(self, time: float) -> None:
        """Discard moves that only matter for times before `time`."""
        while len(self._moves) > 1 and self._moves[1].start <= time:
            self._first = self._moves.pop(0).state(np.array([np.inf]))[0][0]

    def __call__(self, times: Float64[np.ndarray, " T"]) -> Float64[np.ndarray, "T n"]:
        """Return the values at times in seconds."""
        return self._at(np.asarray(times, np.float64))[0]

    def _at(self, times: Float64[np.ndarray, " T"]) -> list[Float64[np.ndarray, "T n"]]:
        # Each time belongs to the last move that has begun by then.
        out = [np.zeros((len(times), len(self._first))) for _ in range(3)]
        out[0][:] = self._first
        which = np.searchsorted([one.start for one in self._moves], times, side="right") - 1
        for k, one in enumerate(self._moves):
            selected = which == k
            if selected.any():
                for into, value in zip(out, one.state(times[selected]), strict=True):
                    into[selected] = value
        return out


class RandomTrack:
    """An endless track between random values; its values do not depend on how the times are split into calls.

    Args:
        rng: source of values and durations.
        draw: returns the next value.
        rest: value at the start.
        moves: shortest and longest move, seconds.
        holds: shortest and longest pause between moves, seconds.
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
            # Random numbers are drawn move by move in order of time, whatever times are asked for.
            start = self._track.end + self._rng.uniform(*self._holds)
            self._track.move(self._draw(self._rng), start, start + self._rng.uniform(*self._moves))
        return self._track(times)

    def discard_before(self, time: float) -> None:
        """Discard moves that only matter for times before `time`."""
        self._track.discard_before(time)
