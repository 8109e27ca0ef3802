"""Drag and pin depth of a garment, found on the surface that was followed through training frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float

from smplxpp.cloth.driver import ClothDriver, DriverConfig
from smplxpp.cloth.garment import Garment, GarmentConfig
from smplxpp.cloth.quality import ClothQuality
from smplxpp.core import BodyParams, InputError, ProgressCallback, ignore_progress, require_at_least, require_between
from smplxpp.template.template import Template

# Farther than this from the followed surface a particle says no more: it hangs in another fold.
MOST = 0.15


@dataclass(frozen=True, kw_only=True)
class CalibrationConfig:
    """What is searched, and when a simulation is worth its while.

    Attributes:
        drags: 1/s.
        pin_depths: metres. All pairs are tried; what lies between them is chaos's luck.
        prior: how far the garment's own drag and pin depth are believed: the distance counts as larger by this share
            for each squared factor of two from them. Slow motion tells drags hardly apart, and what was followed there
            is stiffer than cloth; a motion that does tell finds the same drag with and without it. Pin depths differ by
            less than folds do by chance.
        least_motion: mean distance, in metres, of the tracked surface to skinning from which a part is loose.
        most_share: of skinning's distance to the followed surface that the simulation's may have for what was fitted to
            be kept; else the surface was followed too badly to say anything, and the values stay what they were.
        blocks: of consecutive frames; each is left out once for the uncertainty.
    """

    drags: tuple[float, ...] = (0.625, 1.25, 2.5, 5.0, 10.0)
    pin_depths: tuple[float, ...] = (0.014, 0.03)
    prior: float = 0.08
    least_motion: float = 0.006
    most_share: float = 0.85
    blocks: int = 4

    def __post_init__(self) -> None:
        for name in ("drags", "pin_depths"):
            values = getattr(self, name)
            if not values or min(values) <= 0:
                raise InputError(f"calibration: {name}", expected="one or more above 0", received=str(values))
        for name in ("prior", "least_motion"):
            require_at_least(f"calibration: {name}", getattr(self, name), 0.0)
        require_between("calibration: most_share", self.most_share, 0.0, 1.0)
        require_at_least("calibration: blocks", self.blocks, 2)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What was found for one part.

    Attributes:
        part: its name.
        moves: whether its followed surface leaves skinning.
        fitted: whether the values below are.
        drag, pin_depth: 1/s and metres.
        drag_spread, pin_spread: standard deviations by leaving blocks of frames out
            (jackknife); None where nothing was fitted.
        skinned, simulated: mean distance of particles to the followed surface, metres, by skinning alone and with
            these values.
        frames: how many were looked at.
        quality: of that simulation along the frames; None where none was made.
    """

    part: str
    moves: bool
    fitted: bool
    drag: float
    drag_spread: float | None
    pin_depth: float
    pin_spread: float | None
    skinned: float
    simulated: float
    frames: int
    quality: ClothQuality | None = None


@dataclass(frozen=True, eq=False)
class Followed:
    """A motion and the surface that was followed along it.

    Attributes:
        params: T frames, evenly spaced.
        fps: of them.
        world: where the particles of a garment were found, metres; NaN rows are not looked at, and count for nothing.
        confidence: from 0 to 1, how much each counts; None: all alike.
    """

    params: BodyParams
    fps: float
    world: Float[np.ndarray, "T n 3"]
    confidence: Float[np.ndarray, "T n"] | None = None


def calibrate(
    template: Template,
    garment: Garment,
    followed: Followed,
    *,
    config: CalibrationConfig | None = None,
    driver: DriverConfig | None = None,
    progress: ProgressCallback = ignore_progress,
) -> tuple[Garment, Calibration]:
    """Fit drag and pin depth to a followed surface, where it moves.

    The distance is the mean over particles that move and frames, cut off at `MOST`. Chaos sets its noise: a start moved
    by half a millimetre moves folds by several, so more parameters would be fitted to noise.

    Args:
        followed: of training frames; nothing of frames that are held out.

    Returns:
        The garment with the values, and what was found.

    Raises:
        InputError: a surface of another number of particles or frames, or of no frame at all.
    """
    config = config or CalibrationConfig()
    expected = (len(followed.params), len(garment.particles), 3)
    if followed.world.shape != expected:
        raise InputError("followed surface", expected=f"shape {expected}", received=str(followed.world.shape))
    # A frame counts as followed where at least one particle has a finite place.
    followed_frames = np.isfinite(followed.world).all(axis=2).any(axis=1)
    if not followed_frames.any():
        raise InputError("followed surface", expected="particles in one frame at least", received="none")
    bodies = [template.posed_body(followed.params.frame(k)) for k in range(len(followed.params))]
    # Weigh each particle by its share of the surface. Particles that the deepest trial pins would count for nothing in
    # the choice, so only those that stay free in every trial are weighed, unless no particle does.
    area = _particle_areas(garment) * (garment.depth > max(config.pin_depths))
    if not area.sum() > 0:
        area = _particle_areas(garment)

    # The confidence of the tracking multiplies these weights; without one, all observations count alike.
    trust = np.ones(followed.world.shape[:2]) if followed.confidence is None else followed.confidence

    def errors(positions: Sequence[Float[np.ndarray, "n 3"]]) -> Float[np.ndarray, " L"]:
        """Of the L frames in which the surface was followed."""
        # The weighted mean of min(distance, MOST) over the particles seen in each frame; the cut-off bounds outliers.
        apart = np.linalg.norm((np.stack(positions) - followed.world)[followed_frames], axis=2)
        weight = area * trust[followed_frames] * np.isfinite(apart)
        return (np.minimum(np.nan_to_num(apart, nan=0.0), MOST) * weight).sum(1) / np.maximum(weight.sum(1), 1e-12)

    def simulated(drag: float, pin: float) -> Float[np.ndarray, " L"]:
        # Play all frames from the first with the trial's values: cloth has a history, so frames cannot be drawn at
        # random.
        trial = with_values(garment, drag=drag, pin_depth=pin)
        player = ClothDriver(template, [trial], driver)
        positions = []
        for k, body in enumerate(bodies):
            player.step(followed.params.frame(k), 1.0 / followed.fps, posed=body)
            positions.append(player.particles(trial.part))
        qualities[drag, pin] = player.quality[0]
        return errors(positions)

    # The baseline is linear blend skinning, v' = sum_j w_j (R_j v + t_j). Where it explains the surface already, the
    # cloth hardly moves of its own, and neither parameter can be identified.
    weights = template.weights.dense()[garment.particles]
    blends = [np.einsum("nj,jab->nab", weights, body.posed_from_rest[0, :, :3]) for body in bodies]
    rest = template.vertices[garment.particles]
    skinned = errors([np.einsum("nab,nb->na", b[:, :, :3], rest) + b[:, :, 3] for b in blends])
    if skinned.mean() < config.least_motion:
        return garment, _found(garment, skinned, skinned, moves=False)

    # Search the grid of all pairs: the error is chaotic in the parameters, so it has no useful gradient.
    pairs = list(product(config.drags, config.pin_depths))
    qualities: dict[tuple[float, float], ClothQuality] = {}
    table: dict[tuple[float, float], Float[np.ndarray, " L"]] = {}

    def best(frames: np.ndarray) -> tuple[float, float]:
        """The pair of the least distance in these frames, the prior counted."""

        def cost(pair: tuple[float, float]) -> float:
            # The prior is quadratic in the logarithms: it grows with the octaves away from the garment's values.
            octaves = np.log2(np.divide(pair, (garment.config.fabric.drag, garment.config.pin_depth)))
            return float(table[pair][frames].mean() * (1.0 + config.prior * octaves @ octaves))

        return min(table, key=cost)

    frames = np.arange(len(skinned))
    for done, pair in enumerate(pairs):
        progress("calibration", done / len(pairs))
        table[pair] = simulated(*pair)
    progress("calibration", 1.0)
    drag, pin = best(frames)
    # Keep the garment's own values where the best simulation is not clearly nearer than skinning.
    if table[drag, pin].mean() > config.most_share * skinned.mean():
        return garment, _found(garment, skinned, table[drag, pin], moves=True, quality=qualities[drag, pin])
    # Estimate the spread by the jackknife over blocks of consecutive frames, since neighbouring frames are correlated.
    left_out = [best(np.setdiff1d(frames, block)) for block in np.array_split(frames, config.blocks)]
    spread = [_jackknife([pair[k] for pair in left_out]) for k in (0, 1)]
    found = with_values(garment, drag=drag, pin_depth=pin)
    apart = (spread[0], spread[1])
    return found, _found(found, skinned, table[drag, pin], moves=True, spread=apart, quality=qualities[drag, pin])


def with_values(garment: Garment, *, drag: float, pin_depth: float) -> Garment:
    """Return the garment with another drag, 1/s, and pin depth, metres."""
    fabric = replace(garment.config.fabric, drag=drag)
    config: GarmentConfig = replace(garment.config, fabric=fabric, pin_depth=pin_depth)
    return garment.with_config(config)


def _found(
    garment: Garment,
    skinned: Float[np.ndarray, " L"],
    simulated: Float[np.ndarray, " L"],
    *,
    moves: bool,
    spread: tuple[float, float] | None = None,
    quality: ClothQuality | None = None,
) -> Calibration:
    return Calibration(
        part=garment.part,
        moves=moves,
        fitted=spread is not None,
        drag=garment.config.fabric.drag,
        drag_spread=None if spread is None else spread[0],
        pin_depth=garment.config.pin_depth,
        pin_spread=None if spread is None else spread[1],
        skinned=float(skinned.mean()),
        simulated=float(simulated.mean()),
        frames=len(skinned),
        quality=quality,
    )


def _particle_areas(garment: Garment) -> Float[np.ndarray, " n"]:
    rest = garment.rest
    return np.bincount(rest.faces.ravel(), np.repeat(rest.face_areas / 3.0, 3), minlength=rest.vertex_count)


def _jackknife(values: Sequence[float]) -> float:
    """The standard deviation of an estimate from its values with one block left out each time."""
    n = len(values)
    return float(np.sqrt((n - 1) / n * np.square(np.array(values) - np.mean(values)).sum()))
