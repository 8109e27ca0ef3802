"""Split cameras and frames into training and held-out sets."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from smplxpp.core.errors import InputError


@dataclass(frozen=True)
class Splits:
    """Training and held-out cameras and frames of a capture.

    Attributes:
        train_cameras: names of the cameras that training sees.
        novel_view_cameras: held-out cameras.
        train_frames: frames that training sees.
        novel_pose_frames: held-out frames.

    Raises:
        InputError: a camera or frame that is both trained on and held out.
    """

    train_cameras: tuple[str, ...]
    novel_view_cameras: tuple[str, ...]
    train_frames: tuple[int, ...]
    novel_pose_frames: tuple[int, ...]

    def __post_init__(self) -> None:
        for what, both in (
            ("cameras", sorted(set(self.train_cameras) & set(self.novel_view_cameras))),
            ("frames", sorted(set(self.train_frames) & set(self.novel_pose_frames))),
        ):
            if both:
                raise InputError(
                    f"split of {what}", expected="training and held-out sets apart", received=f"{both[:5]} in both"
                )

    @staticmethod
    def all_train(cameras: Iterable[str], frames: Iterable[int]) -> Splits:
        """Return splits that train on all cameras and frames."""
        return Splits(tuple(cameras), (), tuple(frames), ())

    def hold_out_cameras(self, every: int) -> Splits:
        """Return splits in which every n-th training camera, from the n-th on, is a novel view.

        Raises:
            InputError: `every` below 2, or no training camera would be left to hold out.
        """
        if every < 2 or every > len(self.train_cameras):
            raise InputError(
                "held-out cameras",
                expected=f"every n-th with n from 2 to the number of training cameras, {len(self.train_cameras)}",
                received=str(every),
            )
        held_out = self.train_cameras[every - 1 :: every]
        train = tuple(name for name in self.train_cameras if name not in held_out)
        return Splits(train, self.novel_view_cameras + held_out, self.train_frames, self.novel_pose_frames)

    def restricted(self, cameras: Sequence[str], frames: Sequence[int]) -> Splits:
        """Return the split without cameras and frames that are not among the given ones."""
        names, numbers = set(cameras), set(frames)
        return Splits(
            tuple(c for c in self.train_cameras if c in names),
            tuple(c for c in self.novel_view_cameras if c in names),
            tuple(f for f in self.train_frames if f in numbers),
            tuple(f for f in self.novel_pose_frames if f in numbers),
        )
