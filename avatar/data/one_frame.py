"""Single frames as a training sequence: fixed meshes and their views in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.sequence import Item, MeasuredView
from avatar.data.views import View, read_views
from avatar.rig.rig import Pose, Rig
from smplxpp.capture import Capture
from smplxpp.capture.recording import TURNTABLE
from smplxpp.core import Camera, InputError, spread
from smplxpp.template.template import Template

FRAME = 0
"""Number of the first frame."""


@dataclass(frozen=True, eq=False)
class PosedViews:
    """Views of one frame, and the template in it.

    Attributes:
        vertices: of the template, metres.
        views: whole views, each with a unique name.
    """

    vertices: Float[np.ndarray, "V 3"]
    views: Sequence[View]


def frames_beside(capture: Capture, frame: int) -> tuple[int, ...]:
    """Return the training frames that show other sides of a person who turns before one camera; none elsewhere."""
    # Frames of a turn besides the reference. More of them than every 15 degrees show no other side, but have to
    # be read and kept in memory.
    most_others = 23
    if capture.kind != TURNTABLE:
        return ()
    return tuple(spread([one for one in capture.splits.train_frames if one != frame], most_others))


def views_of_turn(capture: Capture) -> int:
    """Return the number of views of a person who turns before one camera that a fit compares; 0 for other captures."""
    frames = capture.splits.train_frames
    return 1 + len(frames_beside(capture, frames[0])) if capture.kind == TURNTABLE and frames else 0


def other_sides(capture: Capture, frame: int, template: Template) -> tuple[PosedViews, ...]:
    """Read the frames of `frames_beside` with the template in them; views are named by camera and frame.

    Args:
        capture: with the poses of its frames.
        frame: that is known already.
        template: to pose.
    """
    out = []
    for other in frames_beside(capture, frame):
        params = capture.params(other)
        views = read_views(capture, other, capture.splits.train_cameras)
        named = [replace(view, camera=replace(view.camera, name=f"{view.name} {other}")) for view in views]
        if params is not None and named:
            out.append(PosedViews(template.pose(params)[0], named))
    return tuple(out)


class OneFrame:
    """A `FrameSequence` of one frame, or of a few frames of a turn, whose meshes are given.

    Args:
        template: of the person.
        vertices: of the template in the frame, metres.
        train: whole training views of the frame, each with a unique name.
        held_out: whole views for evaluations, each with a unique name.
        others: further frames whose views are trained on, numbered from 1.
        background: sRGB in [0, 1] behind the person.
        margin: pixels kept around the silhouette of a training view.
        device: of all tensors.

    Raises:
        InputError: no training view, two views of one name, or vertices that are not the template's.
    """

    def __init__(
        self,
        template: Template,
        vertices: Float[np.ndarray, "V 3"],
        train: Sequence[View],
        held_out: Sequence[View] = (),
        *,
        others: Sequence[PosedViews] = (),
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        margin: int = 12,
        device: str = "cpu",
    ) -> None:
        # The vertices are the rest shape of the only pose: no body model is evaluated.
        self.rig, self.device = Rig(template, device), device
        self.background: Tensor = torch.tensor(background, dtype=torch.float32, device=device)
        posed = (PosedViews(vertices, train), *others)
        shown = [view for one in posed for view in one.views]
        self.train_frames: tuple[int, ...] = tuple(range(len(posed)))
        self.train_cameras = tuple(view.name for view in shown)
        self._check_names([view.name for view in (*shown, *held_out)])
        self._center = vertices.mean(0)
        self._poses = [self.rig.pose_from_vertices(one.vertices) for one in posed]
        self._frame_of = {view.name: frame for frame, one in enumerate(posed) for view in one.views}
        self._whole = {view.name: view for view in (*shown, *held_out)}
        self._cropped = {view.name: view.cropped(margin).to(device) for view in shown}
        self._measured = [view.name for view in held_out or shown]

    def pose(self, frame: int) -> Pose:
        """Return the pose of a frame, whose skinned mesh has the given vertices."""
        return self._poses[frame]

    def frame_of(self, camera: str) -> int:
        """Return the number of the frame that a view shows."""
        return self._frame_of.get(camera, FRAME)

    def view(self, camera: str, frame: int) -> View:
        """Return a training view, cut to the silhouette."""
        return self._cropped[camera]

    def whole_view(self, camera: str, frame: int = FRAME) -> View:
        """Return all pixels of a view, held out or not."""
        return self._whole[camera].to(self.device)

    def items(self, step: int, *, count: int, views: int, seed: int) -> list[Item]:
        """Return the items of a step; every view comes once an epoch, in an order of the seed and the epoch alone.

        An item of one of several frames has one view.
        """
        # Number views through all steps; dividing by the number of cameras gives the epoch and the place in its order.
        views = min(views, len(self.train_cameras)) if len(self.train_frames) == 1 else 1
        shown = [
            tuple(self._camera_at(number * views + k, seed) for k in range(views))
            for number in range(step * count, (step + 1) * count)
        ]
        return [Item(self.frame_of(cameras[0]), cameras) for cameras in shown]

    def expect(self, items: Sequence[Item]) -> None:
        """Do nothing, because the views are in memory."""

    def measured_views(self, frames: int) -> Iterator[MeasuredView]:
        """Return all held-out views; the training views where none is held out."""
        for name in self._measured:
            yield MeasuredView("novel_view", name, self.whole_view(name), self.frame_of(name))

    def camera(self, name: str) -> Camera:
        """Return a camera with all its pixels."""
        return self._whole[name].camera

    def person_center(self) -> Float[np.ndarray, " 3"]:
        """Return the mean of the vertices, metres."""
        return self._center

    def _camera_at(self, number: int, seed: int) -> str:
        # A new random order of the cameras each epoch.
        epoch, place = divmod(number, len(self.train_cameras))
        order = np.random.default_rng([seed, epoch]).permutation(len(self.train_cameras))
        return self.train_cameras[int(order[place])]

    def _check_names(self, names: Sequence[str]) -> None:
        if not self.train_cameras:
            raise InputError("views of the frame", expected="at least one training view", received="none")
        if len(set(names)) != len(names):
            twice = sorted({name for name in names if names.count(name) > 1})
            raise InputError("views of the frame", expected="each with a unique name", received=", ".join(twice))
