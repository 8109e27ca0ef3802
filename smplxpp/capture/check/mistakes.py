"""The usual mistakes in calibrations and parameters, each as a correction that can be tried."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from smplxpp.core.camera import Camera

# About x: from a world with z up to one with y up.
_Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])


@dataclass(frozen=True, eq=False)
class Sample:
    """A view to try corrections on.

    Attributes:
        camera: as calibrated, of the mask's size.
        mask: the pixels that show the person.
        vertices, faces: the posed body.
        transl: the body's translation.
        pivot_shift: what a turn about the origin, instead of about the root joint, moves the body by.
        neighbours: vertices of frames k later, by k.
    """

    camera: Camera
    mask: Bool[np.ndarray, "H W"]
    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    transl: Float[np.ndarray, " 3"]
    pivot_shift: Float[np.ndarray, " 3"]
    neighbours: Mapping[int, Float[np.ndarray, "V 3"]] = field(default_factory=dict)


CameraCorrection = Callable[[Camera], Camera]
PoseChange = Callable[
    [Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]], tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]
]
BodyCorrection = Callable[[Sample], Float[np.ndarray, "V 3"] | None]


@dataclass(frozen=True)
class Mistake:
    """A correction to try: of the camera, or of the body in the camera's world.

    Attributes:
        words: what is wrong if the correction fits.
        advice: what to do then.
        camera: the corrected camera.
        body: the corrected vertices, None where a sample does not know them.
    """

    words: str
    advice: str
    camera: CameraCorrection = lambda camera: camera
    body: BodyCorrection = lambda sample: sample.vertices


def _posed(change: PoseChange) -> CameraCorrection:
    """Make the correction that changes a camera's R and t."""

    def apply(camera: Camera) -> Camera:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = change(camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3])
        return replace(camera, cam_from_world=pose)

    return apply


def _with_K(change: Callable[[Camera], Float[np.ndarray, "3 3"]]) -> CameraCorrection:
    return lambda camera: replace(camera, K=change(camera))


def _swapped_K(camera: Camera) -> Float[np.ndarray, "3 3"]:
    K = camera.K.copy()
    K[[0, 1], [0, 1]] = camera.K[[1, 0], [1, 0]]
    K[:2, 2] = camera.K[1::-1, 2]
    return K


def _swapped_center(camera: Camera) -> Float[np.ndarray, "3 3"]:
    K = camera.K.copy()
    K[:2, 2] = camera.K[1::-1, 2]
    return K


def _mirrored(camera: Camera) -> Float[np.ndarray, "3 3"]:
    return np.array([[-1.0, 0, camera.width], [0, 1, 0], [0, 0, 1]]) @ camera.K


def _turned_image(camera: Camera) -> Float[np.ndarray, "3 3"]:
    return np.array([[-1.0, 0, camera.width], [0, -1.0, camera.height], [0, 0, 1]]) @ camera.K


def _scaled_transl(scale: float) -> BodyCorrection:
    return lambda sample: sample.vertices + (scale - 1.0) * sample.transl


def _turned_body(rotation: Float[np.ndarray, "3 3"]) -> BodyCorrection:
    return lambda sample: sample.vertices @ rotation.T


def _later_body(frames: int) -> BodyCorrection:
    return lambda sample: sample.neighbours.get(frames)


def _signed_axes(signs: tuple[float, float, float]) -> CameraCorrection:
    return _posed(lambda R, t: (np.diag(signs) @ R, np.diag(signs) @ t))


def _scaled_T(scale: float) -> CameraCorrection:
    return _posed(lambda R, t: (R, scale * t))


def _scaled_K(scale: float) -> CameraCorrection:
    return _with_K(lambda camera: np.diag([scale, scale, 1.0]) @ camera.K)


# With x_cam = R x + t: a file may hold the inverse pose, or only one half of it inverted.
_POSES = tuple(
    Mistake(words, advice, _posed(change))
    for words, advice, change in (
        ("R and T are camera to world", "invert them: R = R_w^T, T = -R_w^T c", lambda R, t: (R.T, -R.T @ t)),
        ("R is camera to world, T is not", "transpose R", lambda R, t: (R.T, t)),
        ("T is the camera's position", "write T = -R c", lambda R, t: (R, -R @ t)),
        ("R is camera to world and T is negated", "transpose R, then write T = R T", lambda R, t: (R.T, R.T @ t)),
    )
)
# Axes of the camera: OpenCV has x right, y down, z forward. Each row negates what another convention turns around.
_AXES = tuple(
    Mistake(words, advice, _signed_axes(signs))
    for words, advice, signs in (
        (
            "the camera looks along -z (OpenGL's and Blender's axes)",
            "negate the second and third row of R and T",
            (1.0, -1.0, -1.0),
        ),
        (
            "the camera's x and y point left and up (PyTorch3D's axes)",
            "negate the first and second row of R and T",
            (-1.0, -1.0, 1.0),
        ),
    )
)
# Up axes of the two worlds. The body is rotated about the world's origin, with its translation.
_UPS = tuple(
    Mistake(words, advice, body=_turned_body(rotation))
    for words, advice, rotation in (
        ("the parameters are in a world with z up", "convert them: `smplxpp params convert --up z`", _Y_UP_FROM_Z_UP),
        ("the cameras are in a world with z up", "turn the cameras' world so that y is up", _Y_UP_FROM_Z_UP.T),
        (
            "cameras and parameters have opposite ways up",
            "turn one of the two worlds by 180 degrees about x",
            np.diag([1.0, -1.0, -1.0]),
        ),
    )
)
# One mistake at a time; the order has no meaning, since the best fit is taken.
SINGLE: tuple[Mistake, ...] = (
    *_POSES,
    *_AXES,
    *_UPS,
    Mistake("T has the wrong sign", "negate T", _posed(lambda R, t: (R, -t))),
    *(
        Mistake(f"T is in {unit}", "write T in metres", _scaled_T(scale))
        for unit, scale in (("millimetres", 1e-3), ("centimetres", 1e-2), ("kilometres", 1e3))
    ),
    *(
        Mistake(f"transl is in {unit}", "write transl in metres", body=_scaled_transl(scale))
        for unit, scale in (("millimetres", 1e-3), ("centimetres", 1e-2))
    ),
    Mistake("x and y are swapped in K", "swap fx and fy, cx and cy", _with_K(_swapped_K)),
    Mistake("cx and cy are swapped", "swap them in K", _with_K(_swapped_center)),
    *(
        Mistake(
            f"K is of images {size} as large",
            "give K for the size of the images",
            _scaled_K(scale),
        )
        for size, scale in (("twice", 0.5), ("four times", 0.25), ("half", 2.0), ("a quarter", 4.0))
    ),
    Mistake("the images are mirrored", "mirror the images and masks left to right", _with_K(_mirrored)),
    Mistake("the images are upside down", "turn the images and masks by 180 degrees", _with_K(_turned_image)),
    Mistake(
        "global_orient turns about the origin (EasyMocap's Rh, Th)",
        "convert the parameters with `smplxpp params convert --layout easymocap`",
        body=lambda sample: sample.vertices + sample.pivot_shift,
    ),
)


def _both(*mistakes: Mistake) -> Mistake:
    """Join corrections, one after the other; at most one of them is of the body."""

    def camera(original: Camera) -> Camera:
        for mistake in mistakes:
            original = mistake.camera(original)
        return original

    # Corrections of cameras compose; of the body at most one takes part, because rotations of its world exclude each
    # other.
    body = next((mistake.body for mistake in mistakes if mistake in _UPS), mistakes[0].body)
    words, advice = (", and ".join(m.words for m in mistakes), "; ".join(m.advice for m in mistakes))
    return Mistake(words, advice, camera, body)


# Two or three conventions at once, as between a renderer and a dataset.
COMBINED: tuple[Mistake, ...] = (
    *(_both(*pair) for kinds in ((_POSES, _AXES), (_POSES, _UPS), (_AXES, _UPS)) for pair in product(*kinds)),
    *(_both(*triple) for triple in product(_POSES, _AXES, _UPS)),
)


def shifts(samples: Sequence[Sample]) -> tuple[Mistake, ...]:
    """Return the mistakes of images that show another frame's pose, as far as the samples know their neighbours."""
    # Frames at the ends of the recording have neighbours on one side only.
    known = {k for sample in samples for k in sample.neighbours}
    return tuple(
        Mistake(
            f"the images show the pose {abs(k)} frame{'s' if abs(k) > 1 else ''} {'later' if k > 0 else 'earlier'}",
            "number images and parameters by one clock",
            body=_later_body(k),
        )
        for k in sorted(known, key=lambda k: (abs(k), k))
    )
