"""A bundle moved and drawn: body parameters to splats in the world to a picture, in numpy and native kernels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np
from jaxtyping import Float32, Float64

from avatar.runtime.blend import BlendSide
from avatar.runtime.bundle import AvatarBundle, load_bundle
from avatar.runtime.clothes import Clothes
from avatar.runtime.field import Field
from avatar.runtime.kernels import SurfaceKernel, WorldKernel, add_basis, joint_transforms
from avatar.runtime.relighting import facing_normals, relit_picture
from avatar.runtime.skeleton import skeleton_body
from avatar.runtime.splatting import Splatter, WorldSplats
from smplxpp.cloth.driver import ClothShape, DriverConfig
from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError
from smplxpp.core.light import Relighting
from smplxpp.core.mesh import TriangleMesh, normalize_rows
from smplxpp.core.params import BodyParams
from smplxpp.native import thread_count

PARTS = ("pose", "field", "blend", "world", "draw")
"""What a picture takes time for: joints and expression; displacements; blend shapes; skinning, frames of
triangles and the way to the world; colours and drawing."""
THICKNESS = 0.01
"""Scale of every Gaussian along its normal, in mean edge lengths of its triangle."""


class AvatarPlayer:
    """An avatar that takes poses.

    Args:
        bundle: the avatar, or its file.
        threads: of the kernels; None: up to 8, a CPU each.
        cloth: how loose clothes follow motions that are stepped through.
        clock: gives seconds.

    Attributes:
        seconds: that the last pose and picture took, by `PARTS`.

    Example:
        >>> player = AvatarPlayer("me.avatar")
        >>> for k in range(len(params)):
        ...     player.step(params.frame(k), 1.0 / 30.0)
        ...     image, alpha = player.draw(camera)
    """

    def __init__(
        self,
        bundle: AvatarBundle | str | Path,
        *,
        threads: int | None = None,
        cloth: DriverConfig | None = None,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        self.bundle = bundle if isinstance(bundle, AvatarBundle) else load_bundle(bundle)
        self.threads = thread_count(threads)
        self.seconds: dict[str, float] = {}
        self._clock = clock
        about, t, sizes = self.bundle.about, self.bundle.tensors, self.bundle.sizes
        self._body = skeleton_body(self.bundle)
        self._parents = np.ascontiguousarray(t["skeleton.parents"], dtype=np.int32)
        self._joints, self._joint_basis = t["skeleton.joints"].astype(np.float64), t["skeleton.expression"]
        self._field = Field(self.bundle) if "field" in self.bundle else None
        self._sides = [BlendSide(self.bundle, side) for side in ("head", "body")] if "blend" in self.bundle else []
        self._clothes = Clothes(self.bundle, cloth) if self.bundle.garments else None
        weights = t["surface.joint_weights"] / t["surface.joint_weights"].sum(axis=1, keepdims=True)
        neighbours, shares = (None, None) if self._field is None else self._field.interpolation
        self._surface = SurfaceKernel(
            sizes["J"],
            t["surface.joint_indices"],
            weights,
            neighbours,
            shares,
            sizes.get("C", 0),
        )
        self._rest = t["surface.vertices"]
        self._posed = np.empty_like(self._rest)
        first = np.concatenate([[0], np.cumsum(t["gaussians.per_face"])]).astype(np.int32)
        self._face_of = np.repeat(np.arange(sizes["F"]), t["gaussians.per_face"])
        own = {name: t[f"gaussians.{name}"] for name in ("barycentric", "offset", "quats", "dc")}
        self._world = WorldKernel(
            t["surface.faces"],
            first,
            own | {"scales": np.exp(t["gaussians.log_scales"])},
            vertices=sizes["V"],
            thickness=THICKNESS,
        )
        count = sizes["N"]
        means, quats, scales, dc = (np.empty((count, width), np.float32) for width in (3, 4, 3, 3))
        self._splats = WorldSplats(
            means,
            quats,
            scales,
            np.ascontiguousarray(t["gaussians.opacities"]),
            dc,
            np.ascontiguousarray(t["gaussians.sh"]),
            self._face_of,
            np.empty((sizes["F"], 3, 3), np.float32),
        )
        self._splatter = Splatter()
        self._eps2d = about.eps2d

    @property
    def motion(self) -> BodyParams | None:
        """What the bundle has to play; None where it has nothing."""
        if not self.bundle.motion:
            return None
        arrays = {name: np.asarray(value, np.float64) for name, value in self.bundle.motion.items()}
        return BodyParams.from_mapping(arrays, source="motion of the bundle")

    @property
    def has_clothes(self) -> bool:
        """Whether there are loose clothes, which `step` simulates."""
        return self._clothes is not None

    @property
    def notes(self) -> list[str]:
        """What went otherwise than asked for with the loose clothes, a sentence each."""
        return [] if self._clothes is None else self._clothes.notes

    @property
    def skinned_clothes(self) -> ClothShape | None:
        """The loose clothes where the joints alone have them, for `pose`; None where there are none."""
        return None if self._clothes is None else self._clothes.skinned

    def step(self, params: BodyParams, seconds: float, *, way: Sequence[BodyParams] = ()) -> WorldSplats:
        """Go on to a pose, the loose clothes simulated; as `pose` where the avatar has none.

        Args:
            params: one frame. seconds: since the last step; of the first one it does not matter.
            way: poses, even in time, that the clothes follow to it instead: those of `smplxpp.cloth.following.ways`
                for a motion that is known whole, or what a `smplxpp.cloth.poses.CausalSmoother` makes of it.

        Raises:
            InputError: several frames, no positive time, parameters of another body.
        """
        if self._clothes is None:
            return self.pose(params)
        return self.pose(params, cloth=self._clothes.step(params, seconds, way))

    def restart(self) -> None:
        """Forget how the clothes moved: the next step starts anew."""
        if self._clothes is not None:
            self._clothes.restart()

    def pose(
        self,
        params: BodyParams,
        *,
        frame: int | None = None,
        cloth: ClothShape | None = None,
    ) -> WorldSplats:
        """Return the avatar in a pose; its arrays are the player's own, which the next pose writes anew.

        Args:
            params: one frame; its shape is not looked at.
            frame: of the training, whose code is taken; None, or one that has none: a new pose.
            cloth: where loose clothes are, over the bundle's vertices; None: where field and skinning have them.

        Raises:
            InputError: several frames, or parameters of another body.
        """
        times = [self._clock()]
        transforms, features, expression = self.joints(params)
        rest = self._shaped(expression, features)
        theta = params.body_pose[0].astype(np.float32)
        times.append(self._clock())
        moved = None if self._field is None else self._field.displacements(theta, frame, self.threads)
        times.append(self._clock())
        displaced = None if cloth is None else self._over_all(cloth)
        added = self._added(theta, expression, params.jaw_pose[0], frame, displaced)
        times.append(self._clock())
        self._surface(rest, moved, displaced, transforms, self._posed, self.threads)
        out = self._splats
        self._world(self._posed, added, (out.means, out.quats, out.scales, out.dc, out.rotations), self.threads)
        times.append(self._clock())
        self.seconds |= {part: b - a for part, a, b in zip(PARTS, times, times[1:], strict=False)}
        return out

    def draw(
        self,
        camera: Camera,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        relighting: Relighting | None = None,
    ) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
        """Return the last pose as a camera sees it: sRGB, not clamped, and its opacity.

        Args:
            relighting: the picture is shown in another light, by the normals that are drawn beside it.

        Raises:
            InputError: what `Splatter.draw` refuses.
        """
        begin = self._clock()
        image, alpha = self._splatter.draw(
            self._splats, camera, background=background, eps2d=self._eps2d, threads=self.threads
        )
        if relighting is not None:
            facing = facing_normals(self.normals, self._splats, camera.position)
            normals, _ = self._splatter.draw(
                self._splats, camera, eps2d=self._eps2d, threads=self.threads, features=facing
            )
            image = relit_picture(image, alpha, normals, relighting, background)
        self.seconds["draw"] = self._clock() - begin
        return image, alpha

    @property
    def normals(self) -> Float32[np.ndarray, "N 3"]:
        """The unit normals of the posed surface where the Gaussians hang on it, smooth over its triangles."""
        t = self.bundle.tensors
        faces = t["surface.faces"]
        smooth = TriangleMesh(self._posed, faces).vertex_normals
        u, v = t["gaussians.barycentric"].T.astype(np.float64)
        corners = smooth[faces[self._face_of]]
        bary = np.stack([u, v, 1.0 - u - v], axis=1)
        return normalize_rows(np.einsum("nk,nkx->nx", bary, corners)).astype(np.float32)

    @property
    def vertices(self) -> Float32[np.ndarray, "V 3"]:
        """The posed vertices that carry Gaussians, metres; the next pose writes them anew."""
        return self._posed

    def joints(
        self, params: BodyParams
    ) -> tuple[Float32[np.ndarray, "J 3 4"], Float32[np.ndarray, " P"] | None, Float32[np.ndarray, " E"]]:
        """Return transforms of the joints, what drives pose correctives (None: there are none), and the expression."""
        if len(params) != 1:
            raise InputError("parameters of a pose", expected="one frame", received=f"{len(params)} frames")
        size, given = self.bundle.sizes["E"], params.expression.shape[1]
        if given > size and np.abs(params.expression[0, size:]).max() > 0.0:
            raise InputError(
                "parameter expression",
                expected=f"at most {size} numbers",
                received=str(given),
                remedy="use parameters of the body that the avatar was made with",
            )
        expression = np.zeros(size, np.float32)
        expression[: min(size, given)] = params.expression[0, :size]
        rest: Float64[np.ndarray, "J 3"] = self._joints
        if expression.any():
            rest = rest + self._joint_basis @ expression
        transforms, features = joint_transforms(
            self._parents,
            np.ascontiguousarray(self._body.axis_angles(params)[0]),
            np.ascontiguousarray(rest, dtype=np.float64),
            np.ascontiguousarray(params.transl[0]),
            features="surface.pose" in self.bundle.tensors,
        )
        return transforms, features, expression

    def _shaped(
        self, expression: Float32[np.ndarray, " E"], features: Float32[np.ndarray, " P"] | None
    ) -> Float32[np.ndarray, "V 3"]:
        """The T-pose with expression and pose correctives."""
        t = self.bundle.tensors
        drives = [("expression", expression)] if expression.any() else []
        drives += [] if features is None else [("pose", features)]
        rest = self._rest if not drives else self._rest.copy()
        for name, coefficients in drives:
            add_basis(rest, t[f"surface.{name}_rows"], t[f"surface.{name}"], coefficients)
        return rest

    def _over_all(self, cloth: ClothShape) -> tuple[Float32[np.ndarray, "V 3"], Float32[np.ndarray, " V"]]:
        displacements, share = np.zeros_like(self._rest), np.zeros(len(self._rest), np.float32)
        displacements[cloth.vertices], share[cloth.vertices] = cloth.displacements, cloth.share
        return displacements, share

    def _added(
        self,
        theta: Float32[np.ndarray, " 63"],
        expression: Float32[np.ndarray, " E"],
        jaw: Float64[np.ndarray, " 3"],
        frame: int | None,
        displaced: tuple[Float32[np.ndarray, "V 3"], Float32[np.ndarray, " V"]] | None,
    ) -> Float32[np.ndarray, "N 6"] | None:
        """What blend shapes add to position and colour; those of the body fade far from what training saw."""
        if not self._sides:
            return None
        keep = None
        if displaced is not None:  # what was learned from a followed surface says nothing of one that is simulated
            still = 1.0 - displaced[1][self.bundle.tensors["surface.faces"]].mean(axis=1)
            keep = np.ascontiguousarray(still[self._face_of], dtype=np.float32)
        head, body = self._sides
        of_head = np.concatenate([expression, jaw]) if self.bundle.about.jaw else expression
        added = np.zeros((self.bundle.sizes["N"], 6), np.float32)
        head.add(of_head.astype(np.float32), 1.0, None, added, self.threads)
        body.add(theta, self.known(theta, frame), keep, added, self.threads)
        return added

    def known(self, theta: Float32[np.ndarray, " 63"], frame: int | None = None) -> float:
        """Return how much a pose counts as one that training saw, in [0, 1]."""
        poses = self.bundle.tensors.get("poses.known")
        if poses is None or frame in self.bundle.about.frames:
            return 1.0
        scale = float(self.bundle.tensors["poses.scale"])
        distance = float(np.sqrt(np.square(poses - theta).sum(axis=1).min()))
        over = max(0.0, (distance - scale) / scale)
        return float(np.exp(-0.5 * over * over))
