"""A single frame as a training sequence: a fixed mesh and its views in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.sequence import Item, MeasuredView
from avatar.data.views import View
from avatar.rig.rig import Pose, Rig
from smplxpp.core import Camera, InputError
from smplxpp.template.template import Template

FRAME = 0
"""Number of the only frame."""


class OneFrame:
    """A `FrameSequence` of one frame, whose mesh is given.

    Args:
        template: of the person.
        vertices: of the template in the frame, metres.
        train: whole training views of the frame, each with a unique name.
        held_out: whole views for evaluations, each with a unique name.
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
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        margin: int = 12,
        device: str = "cpu",
    ) -> None:
        # The vertices are the rest shape of the only pose: no body model is evaluated.
        self.rig, self.device = Rig(template, device), device
        self.background: Tensor = torch.tensor(background, dtype=torch.float32, device=device)
        self.train_frames: tuple[int, ...] = (FRAME,)
        self.train_cameras = tuple(view.name for view in train)
        self._check_names([view.name for view in (*train, *held_out)])
        self._center = vertices.mean(0)
        self._pose = self.rig.pose_from_vertices(vertices)
        self._whole = {view.name: view for view in (*train, *held_out)}
        self._cropped = {view.name: view.cropped(margin).to(device) for view in train}
        self._measured = [view.name for view in held_out or train]

    def pose(self, frame: int) -> Pose:
        """Return the pose, whose skinned mesh has the given vertices."""
        return self._pose

    def view(self, camera: str, frame: int) -> View:
        """Return a training view, cut to the silhouette."""
        return self._cropped[camera]

    def whole_view(self, camera: str, frame: int = FRAME) -> View:
        """Return all pixels of a view, held out or not."""
        return self._whole[camera].to(self.device)

    def items(self, step: int, *, count: int, views: int, seed: int) -> list[Item]:
        """Return the items of a step; every view comes once an epoch, in an order of the seed and the epoch alone."""
        # Number views through all steps; dividing by the number of cameras gives the epoch and the place in its order.
        views = min(views, len(self.train_cameras))
        return [
            Item(FRAME, tuple(self._camera_at(number * views + k, seed) for k in range(views)))
            for number in range(step * count, (step + 1) * count)
        ]

    def expect(self, items: Sequence[Item]) -> None:
        """Do nothing, because the views are in memory."""

    def measured_views(self, frames: int) -> Iterator[MeasuredView]:
        """Return all held-out views; the training views where none is held out."""
        for name in self._measured:
            yield MeasuredView("novel_view", name, self.whole_view(name), FRAME)

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
