"""Simulated clothes in the frames of a capture: each run of frames in order, from a cold start before it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from smplxpp.cloth import ClothDriver, ClothShape, DriverConfig, Garment
from smplxpp.cloth.play import SMOOTHING, followed
from smplxpp.cloth.poses import resampled
from smplxpp.cloth.quality import ClothQuality, merged
from smplxpp.core import BodyParams, GeometryWarning, InputError, require_at_least, require_positive
from smplxpp.template.template import Template


@dataclass(frozen=True, kw_only=True)
class ClothMotionConfig:
    """Choices of the simulation of clothes along a capture.

    Attributes:
        pre_roll: seconds of motion before a run of frames that are simulated after a cold start.
        smoothing: standard deviation of the temporal Gaussian filter of the motion that drives the clothes, seconds,
            because the noise of trackers shakes waistbands. The rendered body is not filtered.
        mode: "simulate", or "skin": the clothes stay where skinning has them.
        driver: of the simulation.
    """

    pre_roll: float = 0.7
    smoothing: float = SMOOTHING
    mode: Literal["simulate", "skin"] = "simulate"
    driver: DriverConfig = field(default_factory=DriverConfig)

    def __post_init__(self) -> None:
        for name in ("pre_roll", "smoothing"):
            require_at_least(f"simulated clothes: {name}", getattr(self, name), 0.0)


class ClothMotions:
    """Shapes of clothes in frames of a motion; a run of frames is simulated at its first request and cached.

    Args:
        template: the person.
        garments: cut from the template.
        params: returns the parameters of a frame, None where there are none.
        frames: all frames of the motion.
        fps: frames a second of their numbers.
        config: of the simulation; None: the defaults.
        seen: returns where the particles of the garments were seen in a frame, by part, world, metres; empty where they
            were not. In the pre-roll the cloth is drawn there, so that a run of frames starts as what was seen ends.

    Attributes:
        quality: what was measured of each garment in the frames that were simulated, without those of the pre-roll.

    Raises:
        InputError: no frames a second.
    """

    def __init__(
        self,
        template: Template,
        garments: Sequence[Garment],
        *,
        params: Callable[[int], BodyParams | None],
        frames: Sequence[int],
        fps: float,
        config: ClothMotionConfig | None = None,
        seen: Callable[[int], Mapping[str, np.ndarray]] = lambda frame: {},
    ) -> None:
        require_positive("frames a second of a motion with simulated clothes", fps)
        # Shapes are kept for the whole training, because a simulation can only be run in order.
        self.template, self.garments, self.config = template, tuple(garments), config or ClothMotionConfig()
        self._params, self._frames, self._fps = params, np.array(sorted(frames), dtype=np.int64), fps
        self._seen = seen
        self._shapes: dict[int, ClothShape] = {}
        self.quality: list[ClothQuality] = []

    def simulate(self, run: Sequence[int]) -> None:
        """Simulate consecutive frames, with the frames before them as pre-roll; simulated ones are skipped.

        Raises:
            InputError: a frame that is not among the motion's.
        """
        # Frames that an earlier run simulated keep their shapes.
        run = sorted(set(run) - set(self._shapes))
        if not run:
            return
        unknown = sorted(set(run) - set(self._frames.tolist()))
        if unknown:
            raise InputError("frames to simulate", expected="some of the motion's", received=str(unknown[:8]))
        if self.config.mode == "skin":
            self._shapes |= dict.fromkeys(run, self.skinned())
            return
        # Frames of pre-roll and run that have parameters, and the poses between them.
        first = run[0] - self.config.pre_roll * self._fps
        span = self._frames[(self._frames >= first) & (self._frames <= run[-1])].tolist()
        known = [frame for frame in span if self._params(frame) is not None]
        paths = self._paths(known)
        # Step the driver through all of them, and keep the shapes of the run.
        driver = ClothDriver(self.template, self.garments, self.config.driver)
        last: int | None = None
        wanted = set(run)
        for frame in known:
            if frame == run[0]:
                driver.measure_anew()
            seconds = self._frame_seconds(frame, last)
            pose_drawn = self._params(frame)
            shape = driver.follow(paths[frame], seconds, pose_drawn if frame in wanted else None)
            if frame in wanted:
                self._shapes[frame] = shape
            # What is measured is predicted from what lies before it alone: nothing of the run itself is looked at.
            elif frame < run[0]:
                for part, places in self._seen(frame).items():
                    driver.draw_to(part, places, self._frame_seconds(frame, last))
            last = frame
        self.quality = merged([*self.quality, *driver.quality])
        for note in driver.notes:
            warnings.warn(f"simulated clothes: {note}", GeometryWarning, stacklevel=2)

    def _frame_seconds(self, frame: int, last: int | None) -> float:
        """Return the seconds since the frame before; of the first one, where the simulation starts cold, a second."""
        return 1.0 if last is None else (frame - last) / self._fps

    def skinned(self) -> ClothShape:
        """Return the shape of clothes that stay where skinning has them."""
        vertices = np.concatenate([garment.vertices for garment in self.garments])
        share = np.concatenate([garment.share() for garment in self.garments])
        return ClothShape(vertices, np.zeros((len(vertices), 3), np.float32), share)

    def shape(self, frame: int) -> ClothShape:
        """Return the shape of the clothes in a simulated frame."""
        return self._shapes[frame]

    def time(self, frame: int) -> float:
        """Return the seconds since the motion's first frame."""
        return float(frame - self._frames[0]) / self._fps

    def _paths(self, frames: Sequence[int]) -> dict[int, list[BodyParams]]:
        """Return the poses from each frame's predecessor to it, filtered within stretches without long gaps.

        Missing frames within a stretch are interpolated, so that the filter is uniform in time. Low frame rates get
        interpolated poses too, because vertices on straight lines from pose to pose would pass through limbs.
        """
        out: dict[int, list[BodyParams]] = {}
        apart = int(np.diff(self._frames).min()) if len(self._frames) > 1 else 1
        # Cut at long gaps.
        cuts = np.flatnonzero(np.diff(frames) > max(apart, self.config.driver.longest_step * self._fps)) + 1
        for stretch in np.split(np.array(frames), cuts):
            found = [self._params(int(frame)) for frame in stretch]
            poses = BodyParams.concatenate([one for one in found if one is not None])
            # Resample to an even spacing, filter in time, and add poses in between.
            even = int(np.gcd.reduce(np.diff(stretch))) if len(stretch) > 1 else apart
            at = (stretch - stretch[0]) // even
            if at[-1] + 1 > len(at):
                poses = resampled(poses, at.astype(float), np.arange(at[-1] + 1.0))
            poses, times = followed(poses, self._fps / even, smoothing=self.config.smoothing)
            out[int(stretch[0])] = [poses.frame(0)]
            # The filtered motion has `times` poses for each even step; those after the previous frame lead to this one.
            for frame, before, now in zip(stretch.tolist()[1:], at[:-1], at[1:], strict=True):
                out[frame] = [poses.frame(int(k)) for k in range(times * before + 1, times * now + 1)]
        return out
