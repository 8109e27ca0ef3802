"""Pose and draw the avatar of a bundle on a GPU, as `avatar.runtime` does in native kernels; record CUDA graphs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from avatar.gaussians import BoundGaussians, triangle_frames, view_colors, world_from_frames
from avatar.gaussians.binding import WorldGaussians
from avatar.gaussians.frames import TriangleFrames
from avatar.rendering.api import rasterize
from avatar.runtime.bundle import AvatarBundle
from avatar.runtime.networks import positional_encoding
from avatar.runtime.splatting import WorldSplats
from smplxpp.core import Camera, InputError
from smplxpp.native import check_size

log = logging.getLogger(__name__)
T = TypeVar("T")


def record_graph(work: Callable[[], T], *, subject: str) -> tuple[Callable[[], object], T] | None:
    """Record work on a GPU as a CUDA graph.

    Args:
        work: reads and writes tensors of the GPU alone, always the same ones, and waits for nothing.
        subject: of the log line where it cannot be recorded.

    Returns:
        What replays it, and its result, whose tensors each replay overwrites; None where it cannot be recorded.
    """
    try:
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):  # what is set up by first calls must not be part of the graph
            for _ in range(3):
                work()
        torch.cuda.current_stream().wait_stream(aside)
        recorded = torch.cuda.CUDAGraph()
        with torch.cuda.graph(recorded):
            result = work()
    except Exception as error:  # noqa: BLE001  whatever a driver raises, the work can be done without a graph
        log.warning("%s is not recorded as a CUDA graph: %s", subject, str(error).split("\n")[0][:300])
        return None
    return recorded.replay, result


@dataclass(frozen=True, eq=False)
class _Posed:
    vertices: Float[Tensor, "V 3"]
    frames: TriangleFrames
    bound: BoundGaussians
    world: WorldGaussians


class SplatsOnDevice(WorldSplats):
    """Splats of a pose on a GPU: an array is copied to the CPU when it is asked for, before the next pose."""

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        object.__setattr__(self, "_tensors", dict(tensors))

    def __getattr__(self, name: str) -> np.ndarray:
        tensors = self.__dict__.get("_tensors", {})
        if name not in tensors:
            raise AttributeError(name)
        object.__setattr__(self, name, tensors[name].cpu().numpy())
        return self.__dict__[name]


class BundleOnDevice:
    """The avatar of a bundle on a GPU: field, blend shapes, skinning, Gaussians and pictures.

    Joints and simulated clothes are the CPU's. A pose is sent in one copy, clothes in a second one; what is computed of
    them is replayed as a CUDA graph where one can be recorded.

    Args:
        bundle: the avatar.
        device: "cuda" or "cuda:1".

    Raises:
        InputError: no such GPU.
    """

    def __init__(self, bundle: AvatarBundle, device: str) -> None:
        if torch.device(device).type != "cuda" or not torch.cuda.is_available():
            raise InputError(
                "device of a player",
                expected="cpu, or a CUDA device that torch can use",
                received=device,
                remedy="leave it out to play on the CPU, or install torch's build for CUDA where there is a GPU",
            )
        self.device, self._sizes, self._eps2d = torch.device(device), bundle.sizes, bundle.about.eps2d
        t = bundle.tensors
        # Surface: rounded to 16 bits, skin weights may miss a sum of 1, as the field's interpolation.
        self._rest, self._faces = self._place(t["surface.vertices"]), self._place(t["surface.faces"])
        self._joint, self._weight = self._place(t["surface.joint_indices"]), self._shares(t["surface.joint_weights"])
        self._bases = {
            name: (self._place(t[f"surface.{name}_rows"]), self._place(t[f"surface.{name}"]))
            for name in ("expression", "pose")
            if f"surface.{name}" in t
        }
        self._field = _Field(self._place, bundle) if "field" in bundle else None
        if self._field is not None:
            self._neighbour, self._share = self._place(t["field.neighbours"]), self._shares(t["field.weights"])
        sides = ("head", "body") if "blend" in bundle else ()
        self._shapes = {side: _Shapes(self._place, bundle, side) for side in sides}
        # Gaussians, sorted by their triangles.
        face_of = np.repeat(np.arange(bundle.sizes["F"]), t["gaussians.per_face"])
        names = ("barycentric", "offset", "log_scales", "quats", "dc", "sh")
        own = {name: self._place(t[f"gaussians.{name}"]) for name in names}
        opacities = self._place(t["gaussians.opacities"])
        self._bound = BoundGaussians(
            **own,
            face_index=self._place(face_of),
            normal_offset=torch.zeros_like(opacities),
            opacity_logits=torch.logit(opacities),
            face_count=bundle.sizes["F"],
            topology="",
        )
        # What a pose is sent in: one vector for all numbers, one for clothes; and the graphs by what they take.
        count = len(self._rest)
        self._widths: dict[str, int] = {}
        self._cloth = torch.zeros(count, 4, device=self.device)
        self._replays: dict[tuple[bool, bool], tuple[Callable[[], object], _Posed] | None] = {}
        self._posed_last: _Posed | None = None

    @torch.no_grad()
    def pose(
        self,
        numbers: Mapping[str, np.ndarray],
        cloth: tuple[Float32[np.ndarray, "V 3"], Float32[np.ndarray, " V"]] | None,
        *,
        coded: bool,
    ) -> SplatsOnDevice:
        """Return the splats of a pose.

        Args:
            numbers: float32 of always the same widths: `transforms` (J 3 4), `expression`, `jaw`, `theta`, `known` (1,
                the weight of the body's shapes), `features` of pose correctives and `code` of the field where the
                bundle has these.
            cloth: displacements of simulated clothes and their share of a vertex's; None without.
            coded: whether the field takes the code; else the regression gives the displacements.
        """
        packed = torch.from_numpy(np.concatenate([value.reshape(-1) for value in numbers.values()], dtype=np.float32))
        if not self._widths:
            self._widths = {name: value.size for name, value in numbers.items()}
            self._input = packed.to(self.device)
        self._input.copy_(packed)
        if cloth is not None:
            self._cloth.copy_(torch.from_numpy(np.concatenate([cloth[0], cloth[1][:, None]], axis=1)))
        # Which network and whether clothes count decides what is computed, hence a graph for each case.
        case = (coded, cloth is not None)
        work = partial(self._posed, *case)
        if case not in self._replays:
            # What could not be recorded once is not tried again.
            failed = None in self._replays.values()
            self._replays[case] = None if failed else record_graph(work, subject="the player")
        replay = self._replays[case]
        if replay is None:
            now = work()
        else:
            replay[0]()
            now = replay[1]
        self._posed_last, world, bound = now, now.world, now.bound
        return SplatsOnDevice(
            {
                "means": world.means,
                "quats": world.quats,
                "scales": world.scales,
                "opacities": world.opacities,
                "dc": bound.dc,
                "sh": bound.sh,
                "face": bound.face_index,
                "rotations": now.frames.rotations,
            }
        )

    @property
    def vertices(self) -> Float32[np.ndarray, "V 3"]:
        """The vertices of the last pose, metres."""
        return self._now.vertices.cpu().numpy()

    @property
    def _now(self) -> _Posed:
        if self._posed_last is None:
            raise InputError("player on a GPU", expected="a pose before its picture", received="none yet")
        return self._posed_last

    @torch.no_grad()
    def draw(
        self,
        camera: Camera,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        features: Float32[np.ndarray, "N 3"] | None = None,
    ) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
        """Draw the last pose, see `Splatter.draw`.

        Raises:
            InputError: an orthographic camera, or a picture too large.
            MissingExtraError: gsplat is not installed.
        """
        if camera.orthographic:
            raise InputError(f"camera {camera.name!r}", expected="a pinhole", received="an orthographic one")
        check_size(camera.width, camera.height, "picture")
        world = self._now.world
        # One copy for the camera: its matrices, its centre and the background.
        parts = (camera.cam_from_world, camera.K, camera.position, np.asarray(background))
        sent = torch.from_numpy(np.concatenate([part.reshape(-1) for part in parts], dtype=np.float32)).to(self.device)
        view, intrinsics, eye, behind = sent.split([16, 9, 3, 3])
        if features is None:
            colors = view_colors(self._now.bound, self._now.frames, world.means, eye[None])
        else:
            colors = self._place(features)[None]
        image, alpha, _ = rasterize(
            *(world.means, world.quats, world.scales, world.opacities, colors),
            view.reshape(1, 4, 4),
            intrinsics.reshape(1, 3, 3),
            *(camera.width, camera.height),
            background=behind,
            eps2d=self._eps2d,
            check=False,
        )
        return image[0].cpu().numpy(), alpha[0, ..., 0].cpu().numpy()

    def _posed(self, coded: bool, clothed: bool) -> _Posed:
        """Compute the pose of the input, without copies from the CPU and without waiting for the GPU."""
        inputs = dict(zip(self._widths, self._input.split([*self._widths.values()]), strict=True))
        # The T-pose with expression and correctives, and the displacements of field and clothes.
        rest = self._rest
        for name, (rows, basis) in self._bases.items():
            rest = rest.index_add(0, rows, basis @ inputs["features" if name == "pose" else name])
        moved = None
        if self._field is not None:
            points = self._field(inputs["theta"], inputs["code"] if coded else None)
            moved = (points[self._neighbour] * self._share[..., None]).sum(1)
        share = self._cloth[:, 3:]
        if clothed:
            own = 0.0 if moved is None else (1.0 - share) * moved
            moved = own + share * self._cloth[:, :3]
        if moved is not None:
            rest = rest + moved
        # Linear blend skinning, then frames, blend shapes and the world.
        transforms = inputs["transforms"].reshape(-1, 12)
        blended = (self._weight[..., None] * transforms[self._joint]).sum(1).reshape(-1, 3, 4)
        vertices = (blended[..., :3] @ rest[..., None])[..., 0] + blended[..., 3]
        frames = triangle_frames(vertices, self._faces)
        bound = self._bound
        if self._shapes:
            # Simulated cloth takes no body shapes, because they were learned on the tracked surface.
            keep = (1.0 - share[self._faces, 0].mean(1))[bound.face_index, None] if clothed else None
            of_head = torch.cat([inputs["expression"], inputs["jaw"]])
            head, body = self._shapes["head"], self._shapes["body"]
            added = torch.zeros(len(bound), 6, device=self.device)
            added = head.add(added, of_head[: head.inputs], 1.0)
            added = body.add(added, inputs["theta"], inputs["known"], keep)
            bound = replace(bound, offset=bound.offset + added[:, :3], dc=bound.dc + added[:, 3:])
        return _Posed(vertices, frames, bound, world_from_frames(bound, frames))

    def _place(self, value: np.ndarray) -> Tensor:
        """Return an array on the GPU: indices as int64, numbers as float32."""
        dtype = torch.float32 if value.dtype.kind == "f" or value.dtype == np.int8 else torch.int64
        return torch.tensor(value, dtype=dtype, device=self.device)

    def _shares(self, value: Float32[np.ndarray, "V n"]) -> Float[Tensor, "V n"]:
        return self._place(value / np.maximum(value.sum(axis=1, keepdims=True), 1e-12))


class _Field:
    """The displacement field, or the regression of new poses, at the control points; see `DisplacementField`."""

    def __init__(self, place: Callable[[np.ndarray], Tensor], bundle: AvatarBundle) -> None:
        t = bundle.tensors
        encoding = positional_encoding(t["field.points"], (bundle.sizes["X"] - 3) // 6)
        self._sets = place(np.repeat(t["field.sets"], 3, axis=1).astype(np.float32))
        self._member, self._cloth = place(t["field.member"]), place(t["field.cloth"])
        self._networks = {}
        for name, rows in (("body", slice(None)), ("cloth", t["field.cloth"])):
            start = f"field.{name}."
            own = {key.removeprefix(start): value for key, value in t.items() if key.startswith(start)}
            # The points' part of the first layer is the same in all poses.
            placed = {key: place(value) for key, value in own.items() if key != "of_point.weight"}
            self._networks[name] = {**placed, "of_point": place(encoding[rows] @ own["of_point.weight"].T)}
        self._regression = {key.split(".")[1]: place(t[key]) for key in t if key.startswith("regression.")}

    def __call__(self, theta: Float[Tensor, " 63"], code: Float[Tensor, " Z"] | None) -> Float[Tensor, "C 3"]:
        """Return the displacements, metres; without a code the regression's."""
        if code is None:
            r = self._regression
            angles = torch.minimum(torch.maximum(theta, r["low"]), r["high"]) - r["center"]
            return r["level"] + r["basis"] @ (r["rows"] @ angles)
        frames = torch.cat([theta * self._sets, code.expand(len(self._sets), -1)], dim=1)
        moved = self._network("body", frames, self._member)
        return moved.index_add(0, self._cloth, self._network("cloth", frames, self._member[self._cloth]))

    def _network(self, name: str, frames: Float[Tensor, "S Y"], member: Tensor) -> Float[Tensor, "c 3"]:
        n = self._networks[name]
        of_frame = torch.nn.functional.linear(frames, n["of_frame.weight"], n["of_frame.bias"])
        x = torch.relu(n["of_point"] + of_frame[member])
        for weight, bias in zip(n["hidden.weight"], n["hidden.bias"], strict=True):
            x = torch.relu(torch.nn.functional.linear(x, weight, bias))
        return torch.nn.functional.linear(x, n["last.weight"], n["last.bias"])


class _Shapes:
    """The blend shapes of head or body, with the network of their coefficients; see `avatar.runtime.networks`."""

    def __init__(self, place: Callable[[np.ndarray], Tensor], bundle: AvatarBundle, side: str) -> None:
        prefix = f"blend.{side}."
        own = {name.removeprefix(prefix): value for name, value in bundle.tensors.items() if name.startswith(prefix)}
        hidden = zip(place(own["hidden.weight"]), place(own["hidden.bias"]), strict=True)
        first, last = ((place(own[f"{name}.weight"]), place(own[f"{name}.bias"])) for name in ("first", "last"))
        self._layers, self.inputs = [first, *hidden, last], own["first.weight"].shape[1]
        # Numbers from their steps, once; Gaussian by Gaussian, as they are multiplied.
        values = place(own["values"])
        if "step" in own:
            values = values * place(own["step"])[..., None]
        if "exponent" in own:
            values = values * torch.exp2(place(own["exponent"]).float())
        self._values = values.permute(2, 1, 0).contiguous()
        self._rows = place(own.get("rows", np.arange(len(self._values))))
        part = bundle.tensors.get("blend.part")
        self._part = None if part is None else place(part)[self._rows]

    def add(
        self,
        added: Float[Tensor, "N 6"],
        inputs: Float[Tensor, " i"],
        known: float | Float[Tensor, " 1"],
        keep: Float[Tensor, "N 1"] | None = None,
    ) -> Float[Tensor, "N 6"]:
        """Return the sum of `added` and the shapes, weighted with `known` and, Gaussian by Gaussian, with `keep`."""
        if not self._values.shape[2]:
            return added
        x = inputs
        for weight, bias in self._layers[:-1]:
            x = torch.relu(weight @ x + bias)
        weight, bias = self._layers[-1]
        z = known * (weight @ x + bias).reshape(-1, self._values.shape[2])
        own = self._values @ z[0] if self._part is None else torch.einsum("mkn,mn->mk", self._values, z[self._part])
        return added.index_add(0, self._rows, own if keep is None else own * keep[self._rows])
