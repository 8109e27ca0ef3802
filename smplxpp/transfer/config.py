"""Hold the settings of skin-weight transfer, and the joints that a part of each label can follow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool

from smplxpp.body.layout import JOINT_NAMES
from smplxpp.core import LABELS, InputError, require_at_least, require_between, require_choice, require_positive
from smplxpp.core.errors import did_you_mean
from smplxpp.core.labels import PartRule

_BOTH = ("left_", "right_")
_TRUNK = ("pelvis", "spine1", "spine2", "spine3")
_ARMS = tuple(side + joint for side in _BOTH for joint in ("collar", "shoulder", "elbow", "wrist"))
_THIGHS = tuple(side + "hip" for side in _BOTH)
_LEGS = _THIGHS + tuple(side + joint for side in _BOTH for joint in ("knee", "ankle", "foot"))

# Joints that a part of each label can follow. Others are impossible, though near: a skirt hangs beside the hands, a
# collar and hair touch the jaw. Everything else stays possible, as hair may fall down the back and a boot reach the
# knee.
JOINTS_OF_LABEL: dict[str, tuple[str, ...]] = {
    "hair": ("head", "neck", "left_collar", "right_collar", *_TRUNK),
    "shoe": tuple(side + joint for side in _BOTH for joint in ("knee", "ankle", "foot")),
    "lower": ("pelvis", "spine1", "spine2", *_LEGS),
    "upper": (*_TRUNK, "neck", *_ARMS, *_THIGHS),
    "outer": (*_TRUNK, "neck", *_ARMS, *_THIGHS, "left_knee", "right_knee"),
}


@dataclass(frozen=True)
class TransferConfig:
    """Settings of `transfer_weights`; every length is a fraction of a mesh's `extent`, so units do not matter.

    The default adds four steps to the published method, each of which None or 0 turns off: `falloff`,
    `smoothing`, `confident`, and (through `for_label`) `allowed_joints`; `published` mixes both.
    `TransferConfig.paper()` is the published method.

    Attributes:
        falloff: p of the extension of the source's weights into free space (`extend_weights`); None copies the closest
            point's weights whatever the distance.
        smoothing: width over which weights are smoothed, as a multiple of the vertex's distance to the source. None
            keeps the weights of matched vertices and inpaints all others.
        normal_widening: growth of that width where the normals are perpendicular (twice that where opposite).
        turned: a vertex that faces away from the nearest skin is smoothed as if it lay this fraction of the source's
            extent away, however near it lies.
        confident: a matched vertex within this fraction of the source's extent is confident and keeps the weights of
            its match. The others get anchor weights from them along the surface, which limit the joints that they may
            follow. None: no vertex is confident.
        far: fractions of the source's extent. Between these distances the anchor weights gradually replace the weights
            of the body nearby.
        around: fractions of the source's extent. Between these distances from the skin a vertex whose ring goes around
            one arm or leg alone (`enclosed_by_one`) gradually takes the mean weights of that limb's skin at its place.
        hanging: widths of a skirt, as distance off the legs by height below the waist with its folds smoothed out,
            between which it becomes a wide one, of which the pelvis keeps a share (`cloth_before_legs`). From 0.2 on
            the benchmark's garments are a little nearer, and the embedded person's skirt is twice as far off in a
            squat. None: whatever hangs before both legs is treated as the rest.
        anchor_length: `l` of the energy that inpaints the anchor weights, as a fraction of the source's extent. With a
            short length a skirt keeps a share of what its waist follows, a longer one continues the trend.
        published: share of the published method's weights in those of cloth off the skin. The errors of both differ, so
            that on loose cloth their mean is mostly nearer to the truth than either.
        published_length: `l` of the energy of that share. The published code has a fixed `l` of 1.4 of whatever unit a
            mesh is in; the default lies between its 1.4 centimetres (0.008), which are better on most loose cloth of
            the benchmark, and its metres, which are better on the skirt of the embedded person.
        allowed_joints: names or indices of the joints that the target may follow; None allows all. They steer what is
            not confident: a confident vertex keeps the joints that it is matched to. Without confident vertices
            (`confident` None) the source is restricted to the faces that these joints own.
        unmatched: what a connected component without any match gets: "extend" the extension like all others,
            "nearest" the closest source point's weights, "rigid:JOINT" (name or index) one joint, "raise" an error.
        max_distance: a vertex is matched within this fraction of the target's extent.
        max_angle_deg: ... and if the normals differ by at most this.
        length_scale: `l` of the energy, as a fraction of the source's extent.
        laplacian: "cotangent" as given; "intrinsic" mollified and Delaunay; "auto" the latter where a face is bad.
        max_influences: joints kept at a vertex; None keeps all.
        rule: how the whole target follows the skeleton, as `smplxpp.core.labels.PartRule` reads it. "auto": as above.
            "rigid:JOINT": one joint, also where the target matched well. "chain:JOINT,JOINT,...": the same transfer
            from the skin of these joints alone, whose weights are normalised; what does not match it is inpainted.
            "isolate": every connected component rigid, as in `rigid_weights`.
        component_rules: other rules for some components, by their number in `SkinWeights.component`.
        averaging_steps: Jacobi averaging over unmatched vertices at the end (rate 0.2).
        joint_names: names for `allowed_joints` and `unmatched`; None takes the names of the SMPL family by the number
            of joints.

    Example:
        >>> smplxpp.TransferConfig.for_label("lower").max_influences
        8
    """

    falloff: float | None = 6.0
    smoothing: float | None = 0.4
    normal_widening: float = 3.5
    turned: float = 0.04
    confident: float | None = 0.015
    far: tuple[float, float] = (0.045, 0.08)
    around: tuple[float, float] = (0.015, 0.04)
    hanging: tuple[float, float] | None = (0.25, 0.3)
    anchor_length: float = 0.06
    published: float = 0.5
    published_length: float = 0.02
    allowed_joints: tuple[str | int, ...] | None = None
    unmatched: str = "extend"
    max_distance: float = 0.05
    max_angle_deg: float = 30.0
    length_scale: float = 0.4
    laplacian: Literal["auto", "cotangent", "intrinsic"] = "auto"
    max_influences: int | None = 8
    rule: str = "auto"
    component_rules: Mapping[int, str] = field(default_factory=dict)
    averaging_steps: int = 0
    joint_names: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        for name in (
            "max_distance",
            "max_angle_deg",
            "length_scale",
            "anchor_length",
            "published_length",
            "smoothing",
            "confident",
        ):
            value = getattr(self, name)
            if value is not None:
                require_positive(f"config {name}", value, finite=False)
        if self.falloff is not None and not self.falloff > 2:
            raise InputError("config falloff", expected="more than 2, or None", received=str(self.falloff))
        for name in ("normal_widening", "turned", "averaging_steps"):
            require_at_least(f"config {name}", getattr(self, name), 0)
        require_between("config published", self.published, 0.0, 1.0)
        for name in ("far", "around", "hanging"):
            value = getattr(self, name)
            if value is None and name == "hanging":
                continue
            if len(value) != 2 or not 0 <= value[0] < value[1]:
                raise InputError(
                    f"config {name}", expected="two fractions, none negative, growing", received=str(value)
                )
        if self.max_influences is not None:
            require_at_least("config max_influences", self.max_influences, 1)
        for rule in (self.rule, *self.component_rules.values()):
            PartRule.parse(rule, subject="config rule")
        require_choice("config laplacian", self.laplacian, ("auto", "cotangent", "intrinsic"))
        if self.unmatched not in ("extend", "nearest", "raise") and not self.unmatched.startswith("rigid:"):
            raise InputError(
                "config unmatched", expected="extend, nearest, raise or rigid:JOINT", received=repr(self.unmatched)
            )
        if self.unmatched == "extend" and (self.falloff is None or self.smoothing is None):
            raise InputError(
                "config unmatched",
                expected="nearest, raise or rigid:JOINT where falloff or smoothing is None",
                received="extend",
            )

    @staticmethod
    def paper() -> TransferConfig:
        """Robust skin weight transfer as published: matched vertices copied, the others inpainted.

        Components that nothing matches (for which the publication says nothing) copy the closest point.
        """
        return TransferConfig(
            falloff=None,
            smoothing=None,
            normal_widening=0.0,
            turned=0.0,
            confident=None,
            published=0.0,
            unmatched="nearest",
        )

    @staticmethod
    def restricted() -> TransferConfig:
        """The default of version 0.1, in which a label's joints overrule matches: for comparison."""
        return TransferConfig(
            confident=None, normal_widening=2.0, turned=0.0, published=0.0, smoothing=0.4, falloff=6.0
        )

    @staticmethod
    def for_label(name: str, *, base: TransferConfig | None = None) -> TransferConfig:
        """Settings for a part of one of `smplxpp.core.labels`: `base` with the joints that such a part can follow.

        Only what is impossible is left out (`JOINTS_OF_LABEL`): hair does not follow the jaw, arms and legs,
        lower clothes not the arms, upper clothes not head, fingers and shins. Skin and things are not restricted. A
        label of one's own has the settings of its `kind`.

        Raises:
            InputError: no built-in label of this name.
        """
        require_choice("label", name, LABELS.names)
        base = base or TransferConfig()
        return replace(base, allowed_joints=JOINTS_OF_LABEL.get(name))

    def joint_index(self, joint: str | int, joint_count: int) -> int:
        """Index of a joint given by name or number.

        Raises:
            InputError: no such joint.
        """
        names = self.joint_names or JOINT_NAMES.get(joint_count, ())
        if joint in names:
            index = names.index(joint)
        else:
            index = int(joint) if str(joint).isdigit() else -1
        if not 0 <= index < joint_count:
            raise InputError(
                f"joint {joint!r}",
                expected=f"an index below {joint_count}, or a name of joint_names",
                received=repr(joint),
                remedy=did_you_mean(joint, names) or "give TransferConfig(joint_names=...) of the body model",
            )
        return index

    def rules_of(self, component_count: int, joint_count: int) -> tuple[PartRule, ...]:
        """The rule of each component.

        Raises:
            InputError: a component that there is not, or a joint that the body has not.
        """
        strange = sorted(k for k in self.component_rules if not 0 <= k < component_count)
        if strange:
            raise InputError(
                "config component_rules", expected=f"components 0 to {component_count - 1}", received=str(strange)
            )
        texts = (self.component_rules.get(k, self.rule) for k in range(component_count))
        rules = tuple(PartRule.parse(text) for text in texts)
        for rule in set(rules):
            for joint in rule.joints:
                self.joint_index(joint, joint_count)
        return rules

    def allowed_mask(self, joint_count: int) -> Bool[np.ndarray, " J"] | None:
        """The joints that a part may follow, or None where all are allowed."""
        if self.allowed_joints is None:
            return None
        mask = np.zeros(joint_count, dtype=bool)
        mask[[self.joint_index(joint, joint_count) for joint in self.allowed_joints]] = True
        return mask
