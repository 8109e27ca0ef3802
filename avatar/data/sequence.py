"""A capture as a training sequence: poses of the template, cropped views, and the order of frames and cameras."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.cloth_motion import ClothMotions
from avatar.data.views import View, read_view
from avatar.rig.rig import Pose, Rig
from smplxpp.capture import Capture
from smplxpp.capture.views import ArrayCache
from smplxpp.core import BodyParams, Camera, InputError, require_at_least
from smplxpp.core.spread import spread_inside
from smplxpp.native import thread_count
from smplxpp.template.template import Template


@dataclass(frozen=True, kw_only=True)
class SequenceConfig:
    """Choices of reading a capture for training.

    Attributes:
        margin: pixels kept around the silhouette of a training view.
        normals: read the capture's normal maps where it has them.
        kept_poses: number of poses kept in memory, the latest used; one has about 1.3 MB for 22k vertices. The
            capture keeps the images, within its own bound.
        readers: threads that decode images of the next steps; None: one on the CPU, which computes the step, and up to
            eight beside a GPU.
    """

    margin: int = 12
    normals: bool = True
    kept_poses: int = 256
    readers: int | None = None

    def __post_init__(self) -> None:
        for name, least in (("margin", 0), ("kept_poses", 1), ("readers", 1)):
            if getattr(self, name) is not None:
                require_at_least(f"sequence: {name}", getattr(self, name), least)


@dataclass(frozen=True)
class Item:
    """A micro-batch of a step: a frame and some of its cameras."""

    frame: int
    cameras: tuple[str, ...]

    def __str__(self) -> str:
        return f"frame {self.frame}, cameras {' '.join(self.cameras)}"


@dataclass(frozen=True, eq=False)
class MeasuredView:
    """A whole view on which a training is evaluated.

    Attributes:
        kind: "novel_view" or "novel_pose".
        name: of the view among those of an evaluation.
        view: all its pixels.
        frame: of its image.
    """

    kind: str
    name: str
    view: View
    frame: int


class FrameSequence(Protocol):
    """Data of photometric trainings: numbered frames, their poses, and views of them.

    Attributes:
        rig: of the template.
        background: (3,) sRGB in [0, 1] behind the person.
        train_cameras: names of the training cameras.
        train_frames: numbers of the training frames.
    """

    rig: Rig
    background: Tensor
    train_cameras: tuple[str, ...]
    train_frames: tuple[int, ...]

    def pose(self, frame: int) -> Pose:
        """Return the pose of a frame."""

    def view(self, camera: str, frame: int) -> View:
        """Return a training view, cut to the silhouette."""

    def items(self, step: int, *, count: int, views: int, seed: int) -> list[Item]:
        """Return the `count` items of a step with up to `views` cameras each; they depend on seed and step alone."""

    def expect(self, items: Sequence[Item]) -> None:
        """Start to read the views of items that the next step needs."""

    def measured_views(self, frames: int) -> Iterable[MeasuredView]:
        """Yield the views of an evaluation, of at most `frames` frames of either kind."""

    def camera(self, name: str) -> Camera:
        """Return a camera with all its pixels."""

    def person_center(self) -> Float[np.ndarray, " 3"]:
        """Return the centre of the person in the first training frame, metres."""


class AvatarSequence:
    """Frames and views of a capture to train an avatar on.

    Args:
        capture: with cameras, images, masks and parameters.
        template: of the person.
        config: of reading.
        device: of all tensors.
        cloth: simulated clothes in frames that are not training frames; None: none.
        cache_gib: bound of the photographs that are kept in memory; None: the capture's own, 1 GiB by default.

    Raises:
        InputError: no training camera or frame, or a training frame without parameters.
    """

    def __init__(
        self,
        capture: Capture,
        template: Template,
        config: SequenceConfig | None = None,
        *,
        device: str = "cpu",
        cloth: ClothMotions | None = None,
        cache_gib: float | None = None,
    ) -> None:
        if cache_gib is not None:
            capture = replace(capture, cache=ArrayCache(round(cache_gib * 2**30)))
        # Images and, for a GPU, poses of the next steps are made while the current step computes.
        self.capture, self.config, self.device = capture, config or SequenceConfig(), device
        self.rig = Rig(template, device)
        self.train_cameras, self.train_frames = _training_part(capture)
        behind = capture.recording.background or (0.0, 0.0, 0.0)
        self.background = torch.tensor(behind, dtype=torch.float32, device=device)
        self.cloth = cloth
        self._poses: OrderedDict[int, Pose] = OrderedDict()
        self._expected: dict[tuple[str, int], Future[View]] = {}
        self._expected_poses: dict[int, Future[Pose]] = {}
        self._of_gpu = self.rig.device.type == "cuda"
        readers = self.config.readers or (thread_count(None) if self._of_gpu else 1)
        # Memory is pinned for the current GPU of a thread, which is the first of a machine unless it is told.
        begin = None if self.rig.device.index is None else partial(torch.cuda.set_device, self.rig.device)
        self._reader = ThreadPoolExecutor(readers, thread_name_prefix="views", initializer=begin)
        self._poser = ThreadPoolExecutor(1, thread_name_prefix="poses", initializer=begin)

    def with_cloth(self, cloth: ClothMotions) -> AvatarSequence:
        """Return the sequence with simulated clothes; both share the images."""
        return AvatarSequence(self.capture, self.rig.template, self.config, device=self.device, cloth=cloth)

    @cached_property
    def normal_maps(self) -> int:
        """Number of training views with a normal map; 0 if normal maps are not read."""
        if not self.config.normals:
            return 0
        # (cameras, frames) masks: training cameras, training frames, images that exist; then maps among them.
        rows = np.isin(list(self.capture.cameras), self.train_cameras)
        views = rows[:, None] & np.isin(self.capture.frames, self.train_frames) & self.capture.presence()
        return int((views & self.capture.presence("normal")).sum())

    def pose(self, frame: int) -> Pose:
        """Return the pose of a frame; training frames keep their number and thereby their code.

        Other frames have simulated clothes, if the sequence has any.

        Raises:
            InputError: a frame without parameters.
        """
        # Least recently used poses are dropped, since a sequence may have thousands of frames.
        if frame not in self._poses:
            expected = self._expected_poses.pop(frame, None)
            found = None if expected is None else expected.result().to(self.device)
            self._poses[frame] = found or self._read_pose(frame)
            if len(self._poses) > self.config.kept_poses:
                self._poses.popitem(last=False)
        self._poses.move_to_end(frame)
        return self._poses[frame]

    def as_new_pose(self, frame: int, *, seen: Float[Tensor, "V 3"] | None = None) -> Pose:
        """Return the pose of a training frame marked as new: without its code, with its loose clothes as in new poses.

        Args:
            frame: of the training.
            seen: displacements of the vertices, metres along the axes of the T-pose: loose clothes lie there. None:
                they are simulated; the first request simulates all training frames in order, from one cold start.
        """
        # A training frame has a code and no simulated clothes otherwise; here it is treated as an unseen one.
        pose = self.pose(frame).as_new()
        if self.cloth is None:
            return pose
        if seen is not None:
            pose = self.rig.with_cloth(pose, self.cloth.skinned(), time=self.cloth.time(frame))
            assert pose.cloth is not None
            return replace(pose, cloth=replace(pose.cloth, displacements=seen))
        self.cloth.simulate(self.train_frames)
        return self.rig.with_cloth(pose, self.cloth.shape(frame), time=self.cloth.time(frame))

    def view(self, camera: str, frame: int) -> View:
        """Return a training view, cut to the silhouette."""
        expected = self._expected.pop((camera, frame), None)
        return (self._read_view(camera, frame) if expected is None else expected.result()).to(self.device)

    def whole_view(self, camera: str, frame: int) -> View:
        """Return all pixels of a view, of any camera and frame of the capture; not cached."""
        return read_view(self.capture, camera, frame).to(self.device)

    def measured_views(self, frames: int) -> Iterator[MeasuredView]:
        """Read views of held-out cameras (of two training cameras where none is held out), person in view.

        They come at training frames ("novel_view") and at held-out frames ("novel_pose"), where there are any.
        """
        # Frames are spread over the sequence without its ends, and views without the person are skipped.
        splits = self.capture.splits
        cameras = splits.novel_view_cameras or splits.train_cameras[:2]
        for kind, own in (("novel_view", self.train_frames), ("novel_pose", splits.novel_pose_frames)):
            for frame in spread_inside(own, frames):
                for camera in cameras:
                    if self.capture.file(camera, frame) is None:
                        continue
                    view = self.whole_view(camera, frame)
                    if view.alpha.any():  # skip views without the person
                        yield MeasuredView(kind, f"{camera} {frame}", view, frame)

    def camera(self, name: str) -> Camera:
        """Return a camera of the capture with all its pixels."""
        return self.capture.cameras[name]

    def person_center(self) -> Float[np.ndarray, " 3"]:
        """Return the mean of the posed vertices in the first training frame, metres."""
        return self.rig.skin(self.pose(self.train_frames[0])).mean(0).cpu().numpy()

    def expect(self, items: Sequence[Item]) -> None:
        """Start to read the views of items in the background, and on a GPU their poses."""
        for item in items:
            if self._of_gpu and item.frame not in self._poses and item.frame not in self._expected_poses:
                self._expected_poses[item.frame] = self._poser.submit(self._pinned_pose, item.frame)
            for camera in item.cameras:
                if (camera, item.frame) not in self._expected:
                    read = self._reader.submit(self._read_view, camera, item.frame)
                    self._expected[camera, item.frame] = read

    def items(self, step: int, *, count: int, views: int, seed: int) -> list[Item]:
        """Return the items of a step; they depend on seed and step alone.

        Every frame comes once an epoch in a shuffled order. From epoch to epoch a frame passes through its cameras, in
        a shuffled order too, so that every view comes equally often.

        Args:
            step: number of the step.
            count: number of items.
            views: cameras of each item; all of a frame's where it has fewer.
            seed: of the orders.
        """
        out = []
        for number in range(step * count, (step + 1) * count):
            # Each epoch visits all frames once, each with its next cameras.
            epoch, place = divmod(number, len(self.train_frames))
            frame = self.train_frames[_shuffled((seed, 0, epoch), len(self.train_frames))[place]]
            out.append(Item(frame, self.cameras(frame, epoch, views, seed)))
        return out

    def cameras(self, frame: int, visit: int, views: int, seed: int) -> tuple[str, ...]:
        """Return training cameras for the n-th visit of a frame, so that every camera comes equally often."""
        # The n-th visit takes the n-th group of cameras in a shuffled cycle; a new cycle has a new order.
        names = [name for name in self.train_cameras if self.capture.file(name, frame) is not None]
        views = min(views, len(names))
        chosen = []
        for number in range(visit * views, (visit + 1) * views):
            cycle, place = divmod(number, len(names))
            chosen.append(names[_shuffled((seed, 1, frame, cycle), len(names))[place]])
        return tuple(chosen)

    def params(self, frame: int) -> BodyParams:
        """Return the body parameters of a frame.

        Raises:
            InputError: a frame without parameters.
        """
        params = self.capture.params(frame)
        if params is None:
            raise InputError(
                f"capture {self.capture.name}",
                expected=f"body parameters of frame {frame}",
                received="none",
                remedy="leave the frame out, or name a file with --params",
            )
        return params

    def _pinned_pose(self, frame: int) -> Pose:
        """Return the pose of a training frame on the CPU; ten milliseconds of numpy that a GPU would wait for."""
        return self.rig.pose(self.params(frame), frame=frame, device="cpu").pinned()

    def _read_pose(self, frame: int) -> Pose:
        # Training frames keep the number that selects their code; all others may have simulated clothes.
        if frame in self.train_frames:
            return self.rig.pose(self.params(frame), frame=frame)
        pose = self.rig.pose(self.params(frame))
        if self.cloth is None:
            return pose
        self.cloth.simulate(self._run_of(frame))
        return self.rig.with_cloth(pose, self.cloth.shape(frame), time=self.cloth.time(frame))

    def _run_of(self, frame: int) -> list[int]:
        """Return the run of frames with parameters around a frame, bounded by training frames."""
        # Extend the run in both directions up to training frames.
        frames, seen = self.capture.frames, set(self.train_frames)
        at = first = last = frames.index(frame)
        while first > 0 and frames[first - 1] not in seen:
            first -= 1
        while last + 1 < len(frames) and frames[last + 1] not in seen:
            last += 1
        run = frames[first : last + 1]
        return [one for one in run if one == frames[at] or self.capture.params(one) is not None]

    def _read_view(self, camera: str, frame: int) -> View:
        whole = read_view(self.capture, camera, frame, normals=self.config.normals)
        view = whole.cropped(self.config.margin)
        return view.pinned() if self._of_gpu else view


def camera_centers_of(views: Sequence[View]) -> Float[Tensor, "C 3"]:
    """Return the centres of projection in the world, metres."""
    return torch.stack([view.position for view in views])


def _training_part(capture: Capture) -> tuple[tuple[str, ...], tuple[int, ...]]:
    cameras = capture.splits.train_cameras
    presence = capture.presence()
    # Training frames with an image in some training camera.
    rows = [row for row, name in enumerate(capture.cameras) if name in set(cameras)]
    seen = {frame for frame, there in zip(capture.frames, np.asarray(presence[rows].any(axis=0)), strict=True) if there}
    frames = tuple(frame for frame in capture.splits.train_frames if frame in seen)
    if not cameras or not frames:
        raise InputError(
            f"capture {capture.name}",
            expected="training cameras with images of training frames",
            received=f"{len(cameras)} cameras, {len(frames)} frames with an image in one of them",
            remedy="see docs/captures.md: splits are read from the capture",
        )
    return cameras, frames


@lru_cache(maxsize=1024)
def _shuffled(seed: tuple[int, ...], count: int) -> np.ndarray:
    return np.random.default_rng(seed).permutation(count)
