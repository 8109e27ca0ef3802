"""A run as it is looked at, without any window: which frame, how it is changed by hand, what there is to draw."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float, Float64, Int64, UInt8
from scipy.spatial.transform import Rotation

from pipelines.viewer.run_models import (
    ShownMotion,
    SplatSource,
    Surface,
    TrainingNow,
    capture_of_run,
    covariances,
    motion_of_run,
    newest_splats,
    open_player,
    tracked_surface,
    training_now,
)
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.capture import Capture
from smplxpp.core import POSE_BLOCKS, BodyParams, matrix_from_rotvec, require_choice, rotvec_from_matrix
from smplxpp.core.light import Relighting
from smplxpp.figures import blend_joint_colors, heat_colors
from smplxpp.template.template import Template

if TYPE_CHECKING:
    from avatar.runtime import AvatarPlayer
    from avatar.runtime.splatting import WorldSplats

Coloring = Literal["photograph", "labels", "weights", "one joint"]
COLORINGS: tuple[Coloring, ...] = ("photograph", "labels", "weights", "one joint")
TURNED = SMPLX_JOINTS[:23]
"""Joints that can be turned by hand: the body's and the jaw."""
_FOLLOWED = 1.0
"""Longest jump of the motion, in seconds, that loose clothes follow; after a longer one they restart."""
_PLACES = {
    name: (block, 3 * k)
    for (block, count), first in zip(POSE_BLOCKS[:3], (0, 1, 22), strict=True)
    for k, name in enumerate(SMPLX_JOINTS[first : first + count])
}


@dataclass(frozen=True, eq=False)
class Layer:
    """A part of the template: its vertices among all, and its faces over these."""

    name: str
    vertices: Int64[np.ndarray, " v"]
    faces: Int64[np.ndarray, "f 3"]


@dataclass(frozen=True, eq=False)
class DrawnSplats:
    """Gaussians in the world: metres, square metres, sRGB and opacity in [0, 1]."""

    means: Float[np.ndarray, "N 3"]
    covariances: Float[np.ndarray, "N 3 3"]
    colors: Float[np.ndarray, "N 3"]
    opacities: Float[np.ndarray, "N 1"]


@dataclass(frozen=True, eq=False)
class _Step:
    """What simulated clothes have followed last: player, frame and what was changed by hand; and what came of it."""

    shown: tuple[AvatarPlayer, int, dict[str, tuple[float, float, float]], dict[str, float]]
    splats: WorldSplats


@dataclass(eq=False)
class RunSession:
    """State of a run in the viewer.

    Attributes:
        run: folder of the run.
        template: template that is posed.
        motion: frames that can be shown.
        capture: photographs, or None.
        player: draws the Gaussians of `source`; None without Gaussians.
        tracked: the tracked surface, or None.
        now: progress of a running training, or None.
        relighting: another light than the capture's, or None.
        relit: whether the Gaussians are shown in it.
        simulated: whether loose clothes are simulated along the shown frames; else field and skinning move them.
        at: row of the motion.
        turned: additional rotation of joints relative to the frame's pose, degrees about x, y and z.
        expression: added to the frame's coefficients.
    """

    run: Path
    template: Template
    motion: ShownMotion
    capture: Capture | None = None
    player: AvatarPlayer | None = None
    source: SplatSource | None = None
    tracked: Surface | None = None
    now: TrainingNow | None = None
    relighting: Relighting | None = None
    relit: bool = True
    simulated: bool = False
    at: int = 0
    turned: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    expression: dict[str, float] = field(default_factory=dict)
    _stepped: _Step | None = None

    @property
    def frame(self) -> int:
        """The number of the frame that is shown."""
        return self.motion.numbers[self.at]

    @property
    def layers(self) -> list[Layer]:
        """The parts of the template, the body first."""
        out = []
        for name in self.template.part_names:
            faces = self.template.faces[self.template.part_faces(name)]
            vertices, local = np.unique(faces, return_inverse=True)
            out.append(Layer(name, vertices, local.reshape(-1, 3).astype(np.int64)))
        return out

    @property
    def expressions(self) -> tuple[str, ...]:
        """Names of the expressions that can be added."""
        body = self.template.body
        names = body.expression_names
        return tuple(names) if names else tuple(f"expression {k}" for k in range(body.num_expressions))

    def go_to(self, row: int) -> None:
        """Show another frame, the first after the last."""
        self.at = row % len(self.motion.numbers)

    def turn(self, joint: str, degrees: tuple[float, float, float]) -> None:
        """Turn a joint relative to the frame's pose."""
        require_choice("joint", joint, TURNED)
        self.turned[joint] = degrees

    def reset(self) -> None:
        """Take back what was turned and added by hand."""
        self.turned.clear()
        self.expression.clear()

    @property
    def params(self) -> BodyParams:
        """The frame's parameters, with what was changed by hand."""
        params = self.motion.params.frame(self.at)
        blocks: dict[str, Any] = {name: np.array(getattr(params, name)) for name, _ in POSE_BLOCKS[:3]}
        for joint, degrees in self.turned.items():
            block, first = _PLACES[joint]
            own = blocks[block][0, first : first + 3]
            # The rotation by hand acts first, about the joint's own axes: R = R_frame R_hand.
            added = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
            blocks[block][0, first : first + 3] = rotvec_from_matrix(matrix_from_rotvec(own) @ added)
        # The motion may have fewer coefficients than the body: missing ones are 0.
        expression = np.zeros((1, max(params.expression.shape[1], len(self.expressions) if self.expression else 0)))
        expression[:, : params.expression.shape[1]] = params.expression
        for name, value in self.expression.items():
            expression[0, self.expressions.index(name)] += value
        return replace(params, **blocks, expression=expression)

    def vertices(self) -> Float64[np.ndarray, "V 3"]:
        """The template as its joints have it, metres."""
        return self.template.pose(self.params)[0]

    def tracked_vertices(self) -> Float[np.ndarray, "V 3"] | None:
        """The tracked surface of the frame; None where the teacher did not track it."""
        return None if self.tracked is None else self.tracked(self.frame, self.motion.params.frame(self.at))

    def colors(self, coloring: Coloring, joint: str | None = None) -> UInt8[np.ndarray, "V 3"]:
        """Colours of the template's vertices; `joint` is the one whose weights are shown as heat."""
        require_choice("colours", coloring, COLORINGS)
        if coloring == "photograph":
            return self.template.vertex_colors
        if coloring == "labels":
            return self.template.labels.display_colors(self.template.vertex_labels)
        if coloring == "weights":
            return blend_joint_colors(self.template.weights)
        names = self.template.body.joint_names
        require_choice("joint", joint or names[0], names)
        weights = self.template.weights.dense()[:, names.index(joint or names[0])]
        return heat_colors(weights, cmap="weight", limits=(0.0, 1.0))

    def splats(self, eye: Float[np.ndarray, " 3"]) -> DrawnSplats | None:
        """The Gaussians as they look from a point, metres; None where the run has none."""
        if self.player is None:
            return None
        drawn = self._posed(self.player)
        colors = np.clip(drawn.colors(np.ascontiguousarray(eye, dtype=np.float32)), 0.0, 1.0)
        if self.relighting is not None and self.relit:
            colors = self.relighting.colors(colors, self.player.normals)
        return DrawnSplats(
            drawn.means.copy(),
            covariances(drawn.quats.astype(np.float64), drawn.scales.astype(np.float64)),
            colors,
            drawn.opacities[:, None].copy(),
        )

    @property
    def dressed(self) -> bool:
        """Whether the Gaussians have loose clothes that can be simulated."""
        return self.player is not None and self.player.has_clothes

    def _posed(self, player: AvatarPlayer) -> WorldSplats:
        """The Gaussians of what is shown; simulated clothes go on from what was shown before."""
        if not (self.simulated and self.dressed):
            self._stepped = None
            return player.pose(self.params, frame=self.frame if self.motion.photographed and not self.turned else None)
        now, before = (player, self.frame, dict(self.turned), dict(self.expression)), self._stepped
        if before is not None and before.shown == now:
            return before.splats
        passed = 0 if before is None else self.frame - before.shown[1]
        # Other frames than the next ones are another scene.
        if before is None or before.shown[0] is not player or not 0 <= passed <= _FOLLOWED * self.motion.fps:
            player.restart()
        self._stepped = _Step(now, player.step(self.params, max(passed, 1) / self.motion.fps))
        return self._stepped.splats

    def refresh(self) -> bool:
        """Look again what a training has left; returns whether there are other Gaussians than before."""
        self.now = training_now(self.run)
        source = newest_splats(self.run, self.now)
        if source is None or source == self.source:
            return False
        self.player, self.source = open_player(self.run, self.template, source), source
        return True


def open_run(
    run: Path,
    template: Template,
    *,
    capture: Path | None = None,
    params: Path | None = None,
    fps: float | None = None,
    relighting: Relighting | None = None,
) -> RunSession:
    """Open what a run has to show.

    Args:
        template: of the run. capture, params: in the place of those that the run remembers.
        fps: frames a second of the parameters; None: as they state.
        relighting: another light for the Gaussians.

    Raises:
        InputError: a capture or parameters that cannot be read, models of another template.
    """
    shown = capture_of_run(run, capture)
    motion = motion_of_run(run, template, shown, params, fps=fps)
    session = RunSession(run, template, motion, shown, tracked=tracked_surface(run, template), relighting=relighting)
    session.refresh()
    # Frames of the training have codes that know their clothes; a new motion has none.
    session.simulated = session.dressed and not motion.photographed
    return session
