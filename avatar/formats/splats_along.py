"""Yield splats of an avatar along a motion with simulated loose clothes, without torch."""

from __future__ import annotations

from collections.abc import Iterator

from avatar.formats.splats import Splats, world_splats
from avatar.runtime import AvatarPlayer
from smplxpp.cloth.following import ways
from smplxpp.core.params import DEFAULT_FPS, BodyParams

PRE_ROLL = 0.7
"""Seconds of a motion before its first frame that loose clothes follow, so that they hang when it begins."""


def splats_along(
    player: AvatarPlayer,
    motion: BodyParams,
    rows: range,
    *,
    cloth: str = "simulate",
    notes: list[str] | None = None,
) -> Iterator[Splats]:
    """Yield the splats of rows of a motion; simulated clothes follow it from a moment before the first row.

    Args:
        player: of the avatar.
        motion: body parameters.
        rows: ascending.
        cloth: what moves loose clothes: "simulate", "field" or "skin".
        notes: receives the player's remarks on the simulation after the last row.
    """
    # Without a simulation every pose stands alone: clothes follow the field, or skinning.
    rate = motion.fps or DEFAULT_FPS
    if cloth != "simulate" or not player.has_clothes:
        skinned = player.skinned_clothes if cloth == "skin" else None
        for k in rows:
            yield world_splats(player.pose(motion.frame(k), cloth=skinned))
        return
    # A simulation has a state, so that rows before the first are stepped too and not written.
    begin = max(0, rows[0] - round(PRE_ROLL * rate))
    for k, path in enumerate(ways(motion.select(slice(begin, rows[-1] + 1)), rate), start=begin):
        posed = player.step(motion.frame(k), 1.0 / rate, path=path)
        if k in rows:
            yield world_splats(posed)
    if notes is not None:
        notes += player.notes
