"""Pose and draw the avatar of a bundle, in numpy and native kernels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from avatar.runtime.bundle import AvatarBundle, load_bundle, read_motion, undressed
from avatar.runtime.kernels import SurfaceKernel, WorldKernel, add_basis, joint_transforms
from avatar.runtime.networks import BlendShapes, DisplacementField
from avatar.runtime.skeleton import LooseClothes, skeleton_body
from avatar.runtime.splatting import Splatter, WorldSplats, facing_normals, relit_picture
from smplxpp.cloth.driver import ClothShape, DriverConfig
from smplxpp.cloth.quality import ClothQuality
from smplxpp.core import BodyParams, Camera, InputError, TriangleMesh, normalize_rows
from smplxpp.core.light import Relighting
from smplxpp.native import thread_count

PARTS = ("pose", "field", "blend", "world", "draw")
"""Steps whose time is measured: joints and expression; displacement field; blend shapes; skinning and the transform of
Gaussians to the world; colours and drawing."""
THICKNESS = 0.01
"""Scale of every Gaussian along its normal, in mean edge lengths of its triangle."""


class AvatarPlayer:
    """A player of an avatar: body parameters in, splats and pictures out.

    Args:
        bundle: the avatar, or its file.
        threads: of the kernels; None: the number of CPUs, at most 8.
        device: "cpu"; or "cuda", which needs torch and gsplat: all but joints and simulated clothes is computed there,
            and splats are copied to the CPU when their arrays are asked for.
        cloth: configuration of the cloth simulation; None: the bundle's.
        clock: returns seconds.

    Attributes:
        seconds: duration of the last pose and picture, by `PARTS`; on a GPU `world` is all that follows the joints.

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
        device: str = "cpu",
        cloth: DriverConfig | None = None,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        self.bundle = bundle if isinstance(bundle, AvatarBundle) else load_bundle(bundle)
        self.threads = thread_count(threads)
        self.seconds: dict[str, float] = {}
        self._clock = clock
        # Skeleton in float64, since errors add up along the chains
        # of joints; field, blend shapes and clothes are optional.
        t = self.bundle.tensors
        self._body = skeleton_body(self.bundle)
        self._parents = np.ascontiguousarray(t["skeleton.parents"], dtype=np.int32)
        self._joints, self._joint_basis = t["skeleton.joints"].astype(np.float64), t["skeleton.expression"]
        self._field = DisplacementField(self.bundle) if "field" in self.bundle else None
        self._clothes = LooseClothes(self.bundle, cloth) if self.bundle.garments else None
        self._rest = t["surface.vertices"]
        self._face_of = np.repeat(np.arange(self.bundle.sizes["F"]), t["gaussians.per_face"])
        # What poses and pictures are written into, and where; parts that are hidden change none of it.
        N, F = self.bundle.sizes["N"], self.bundle.sizes["F"]
        shapes = ((N, 3), (N, 4), (N, 3), (N, 3), (F, 3, 3))
        self._posed, self._arrays = np.empty_like(self._rest), [np.empty(shape, np.float32) for shape in shapes]
        self._splatter, self._eps2d = Splatter(), self.bundle.about.eps2d
        self._place, self._device = device, None
        self._prepare(self.bundle)

    def hide(self, parts: Collection[str]) -> None:
        """Take parts off from the next pose on, and put all others on; skin under them lies bare (`undressed`).

        Args:
            parts: names, of `bundle.about.part_names`; none: everything is shown, bit for bit as before.

        Raises:
            InputError: a name that the avatar has no part of.
        """
        names = self.bundle.about.part_names
        for part in parts:
            if part not in names:
                raise InputError("part to hide", expected=f"one of {', '.join(names)}", received=repr(part)[:80])
        self._prepare(undressed(self.bundle, [names.index(part) for part in parts]))

    def _prepare(self, shown: AvatarBundle) -> None:
        """Make the kernels of the CPU and the arrays that they write, or the avatar on a GPU."""
        if self._place != "cpu":
            import avatar  # what needs torch lies above this room; the front door knows where

            self._device = avatar.BundleOnDevice(shown, self._place)
            return
        t, sizes = shown.tensors, shown.sizes
        self._sides = [BlendShapes(shown, side) for side in ("head", "body")] if "blend" in shown else []
        # Kernels: skinning, and Gaussians to the world.
        # Rounded to 16 bits, skinning weights may miss a sum of
        # 1, and the surface would then be scaled about the origin.
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
        # Gaussians are sorted by face, so that `first[f] .. first[f + 1]` are those of face f.
        first = np.concatenate([[0], np.cumsum(t["gaussians.per_face"])]).astype(np.int32)
        own = {name: t[f"gaussians.{name}"] for name in ("barycentric", "offset", "quats", "dc")}
        self._world = WorldKernel(
            t["surface.faces"],
            first,
            own | {"scales": np.exp(t["gaussians.log_scales"])},
            vertices=sizes["V"],
            thickness=THICKNESS,
        )
        # Output arrays, reused for every pose.
        means, quats, scales, dc, rotations = self._arrays
        opacities, sh = (np.ascontiguousarray(t[f"gaussians.{name}"]) for name in ("opacities", "sh"))
        self._splats = WorldSplats(means, quats, scales, opacities, dc, sh, self._face_of, rotations)

    @property
    def motion(self) -> BodyParams | None:
        """The motion stored in the bundle; None if there is none."""
        return read_motion(self.bundle)

    @property
    def has_clothes(self) -> bool:
        """Whether the avatar has loose clothes, which `step` simulates."""
        return self._clothes is not None

    @property
    def notes(self) -> list[str]:
        """Remarks on the simulation of the loose clothes, a sentence each."""
        return [] if self._clothes is None else self._clothes.notes

    @property
    def cloth_quality(self) -> list[ClothQuality]:
        """How well the simulated clothes held in the steps until now; none without clothes."""
        return [] if self._clothes is None else self._clothes.quality

    @property
    def skinned_clothes(self) -> ClothShape | None:
        """The loose clothes after linear blend skinning, for `pose`; None if there are none."""
        return None if self._clothes is None else self._clothes.skinned

    def step(self, params: BodyParams, seconds: float, *, path: Sequence[BodyParams] = ()) -> WorldSplats:
        """Step to a pose with simulated loose clothes; without such clothes it is `pose`.

        Args:
            params: one frame.
            seconds: since the last step; ignored in the first one.
            path: poses, evenly spaced in time, that the clothes follow to it: those of `smplxpp.cloth.play.ways`
                for a motion that is known whole, or the output of a `smplxpp.cloth.poses.CausalSmoother`.

        Raises:
            InputError: several frames, no positive time, parameters of another body.
        """
        if self._clothes is None:
            return self.pose(params)
        return self.pose(params, cloth=self._clothes.step(params, seconds, path))

    def restart(self) -> None:
        """Discard the state of the clothes; the next step starts a new simulation."""
        if self._clothes is not None:
            self._clothes.restart()

    def pose(
        self,
        params: BodyParams,
        *,
        frame: int | None = None,
        cloth: ClothShape | None = None,
    ) -> WorldSplats:
        """Return the splats of a pose, in arrays that the next pose overwrites.

        Args:
            params: one frame; its shape coefficients are ignored.
            frame: frame of the training whose code is used; None, or one without a code: a new pose.
            cloth: positions of loose clothes, with the bundle's vertices; None: they follow field and skinning.

        Raises:
            InputError: several frames, or parameters of another body.
        """
        # Joints and T-pose, displacement field, blend shapes, then skinning and the world; each is timed.
        times = [self._clock()]
        transforms, features, expression = self.joints(params)
        if self._device is not None:
            times.append(self._clock())
            numbers, coded = self._numbers(params, frame, transforms, features, expression)
            spread = None if cloth is None else self._spread_cloth(cloth)
            self._splats = self._device.pose(numbers, spread, coded=coded)
            self.seconds |= {"pose": times[1] - times[0], "world": self._clock() - times[1]}
            return self._splats
        rest = self._shape(expression, features)
        theta = params.body_pose[0].astype(np.float32)
        times.append(self._clock())
        # Displacements at the control points, metres; the skinning kernel interpolates them to the vertices.
        moved = None if self._field is None else self._field.displacements(theta, frame, self.threads)
        times.append(self._clock())
        displaced = None if cloth is None else self._spread_cloth(cloth)
        added = self._blend(theta, expression, params.jaw_pose[0], frame, displaced)
        times.append(self._clock())
        # x = (sum_j w_j G_j)(v + dv) for the vertices, then means, rotations and scales of the Gaussians from their
        # posed triangles. The arrays are those of the last pose, overwritten.
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
        """Draw the last pose: sRGB, not clamped, and its opacity.

        Args:
            camera: a pinhole camera.
            background: sRGB.
            relighting: another light, applied by the drawn normals; None: the capture's.

        Raises:
            InputError: as `Splatter.draw`.
        """
        begin = self._clock()
        draw = self._device.draw if self._device is not None else self._draw
        # Draw the colours; a relit picture also needs the normals, which the same splats blend in a second pass.
        image, alpha = draw(camera, background=background)
        if relighting is not None:
            normals, _ = draw(camera, features=facing_normals(self.normals, self._splats, camera.position))
            image = relit_picture(image, alpha, normals, relighting, background)
        self.seconds["draw"] = self._clock() - begin
        return image, alpha

    def _draw(self, camera: Camera, **options: Any) -> tuple[np.ndarray, np.ndarray]:
        return self._splatter.draw(self._splats, camera, eps2d=self._eps2d, threads=self.threads, **options)

    @property
    def normals(self) -> Float32[np.ndarray, "N 3"]:
        """The unit normals of the posed surface at the Gaussians, interpolated from the vertices."""
        # Interpolate the vertex normals (faces weighted by angle) at each Gaussian's barycentrics, and normalise.
        t = self.bundle.tensors
        faces = t["surface.faces"]
        smooth = TriangleMesh(self.vertices, faces).vertex_normals
        u, v = t["gaussians.barycentric"].T.astype(np.float64)
        corners = smooth[faces[self._face_of]]
        bary = np.stack([u, v, 1.0 - u - v], axis=1)
        return normalize_rows(np.einsum("nk,nkx->nx", bary, corners)).astype(np.float32)

    @property
    def vertices(self) -> Float32[np.ndarray, "V 3"]:
        """The posed vertices that carry Gaussians, metres; the next pose overwrites them."""
        return self._posed if self._device is None else self._device.vertices

    def joints(
        self, params: BodyParams
    ) -> tuple[Float32[np.ndarray, "J 3 4"], Float32[np.ndarray, " P"] | None, Float32[np.ndarray, " E"]]:
        """Return the joints' transforms, the features of pose correctives (None without them), and the expression."""
        if len(params) != 1:
            raise InputError("parameters of a pose", expected="one frame", received=f"{len(params)} frames")
        # Coefficients that the avatar does not have may be 0: they would change nothing.
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
        # Expressions move joints too (the jaw's, for example): rest = J + B e.
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

    def _numbers(
        self,
        params: BodyParams,
        frame: int | None,
        transforms: Float32[np.ndarray, "J 3 4"],
        features: Float32[np.ndarray, " P"] | None,
        expression: Float32[np.ndarray, " E"],
    ) -> tuple[dict[str, np.ndarray], bool]:
        """Return what a GPU needs of a pose, and whether the field takes a code."""
        theta = params.body_pose[0].astype(np.float32)
        numbers = {"transforms": transforms, "expression": expression, "jaw": params.jaw_pose[0], "theta": theta}
        numbers["known"] = np.array([self.pose_similarity(theta, frame)])
        if features is not None:
            numbers["features"] = features
        if self._field is None:
            return numbers, False
        code = self._field.code(frame)
        return {**numbers, "code": self._field.null_code if code is None else code}, code is not None

    def _shape(
        self, expression: Float32[np.ndarray, " E"], features: Float32[np.ndarray, " P"] | None
    ) -> Float32[np.ndarray, "V 3"]:
        """Return the T-pose with expression and pose correctives."""
        # Neutral frames need no copy: with no expression and no correctives the T-pose is used as it is.
        t = self.bundle.tensors
        drives = [("expression", expression)] if expression.any() else []
        drives += [] if features is None else [("pose", features)]
        rest = self._rest if not drives else self._rest.copy()
        for name, coefficients in drives:
            add_basis(rest, t[f"surface.{name}_rows"], t[f"surface.{name}"], coefficients)
        return rest

    def _spread_cloth(self, cloth: ClothShape) -> tuple[Float32[np.ndarray, "V 3"], Float32[np.ndarray, " V"]]:
        # Scatter from the vertices of garments to all; elsewhere the share is 0 and the field's displacement stays.
        displacements, share = np.zeros_like(self._rest), np.zeros(len(self._rest), np.float32)
        displacements[cloth.vertices], share[cloth.vertices] = cloth.displacements, cloth.share
        return displacements, share

    def _blend(
        self,
        theta: Float32[np.ndarray, " 63"],
        expression: Float32[np.ndarray, " E"],
        jaw: Float64[np.ndarray, " 3"],
        frame: int | None,
        displaced: tuple[Float32[np.ndarray, "V 3"], Float32[np.ndarray, " V"]] | None,
    ) -> Float32[np.ndarray, "N 6"] | None:
        """Return the blend shapes' contribution to position and colour; the body's fades for unknown poses."""
        if not self._sides:
            return None
        # Simulated cloth takes no blend shapes, because they were learned on the tracked surface.
        keep = None
        if displaced is not None:
            unsimulated = 1.0 - displaced[1][self.bundle.tensors["surface.faces"]].mean(axis=1)
            keep = np.ascontiguousarray(unsimulated[self._face_of], dtype=np.float32)
        # The head's shapes depend on the face alone, so that they count fully in any pose of the body.
        head, body = self._sides
        of_head = np.concatenate([expression, jaw]) if self.bundle.about.jaw else expression
        added = np.zeros((self.bundle.sizes["N"], 6), np.float32)
        head.add(of_head.astype(np.float32), 1.0, None, added, self.threads)
        body.add(theta, self.pose_similarity(theta, frame), keep, added, self.threads)
        return added

    def pose_similarity(self, theta: Float32[np.ndarray, " 63"], frame: int | None = None) -> float:
        """Return the similarity of a pose to the training's poses, in [0, 1]: 1 within the bundle's scale."""
        # The excess x = (d - s) / s of the distance d to the nearest training pose (radians, over 63 angles) gives
        # exp(-x^2 / 2): 1 up to the scale s, and 0.14 at three times it.
        poses = self.bundle.tensors.get("poses.known")
        if poses is None or frame in self.bundle.about.frames:
            return 1.0
        scale = float(self.bundle.tensors["poses.scale"])
        distance = float(np.sqrt(np.square(poses - theta).sum(axis=1).min()))
        over = max(0.0, (distance - scale) / scale)
        return float(np.exp(-0.5 * over * over))
