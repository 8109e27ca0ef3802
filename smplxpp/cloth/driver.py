"""Cloth along a motion, pose after pose: what a player, a film and an evaluation step through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32, Int64

from smplxpp.body.model import PosedBody
from smplxpp.cloth.embedding import SkinnedRows
from smplxpp.cloth.garment import Garment
from smplxpp.cloth.model import SolverConfig
from smplxpp.cloth.poses import pose_between, reference_facing_as
from smplxpp.cloth.quality import ClothQuality
from smplxpp.cloth.thread import GarmentThread
from smplxpp.core import BodyParams, InputError, require_at_least, require_between, require_choice, require_positive
from smplxpp.core.errors import one_line
from smplxpp.template.template import Template


@dataclass(frozen=True, kw_only=True)
class DriverConfig:
    """Options of a cloth driver: cold starts, cuts and the solver.

    A bundle holds all of them, so that a page repeats none.

    Attributes:
        ramp: seconds in which a cold start goes from the reference pose, where the cloth is at rest, to the first one.
        ramp_step: seconds of its steps.
        hold: seconds for which it then stays there.
        longest_step: seconds; a longer step is a cut and restarts, because cloth does not follow straight lines.
        teleport: speed, in metres a second, of the cloth's attachments above which a motion is a cut and restarts.
        most_stretch: length of the longest edge over that at rest from which the cloth is taken to have exploded.
        most_drawn: longest drawn edge over its length at rest; above `SolverConfig.most_stretch`, because the drawn
            surface bends about the simulated one at a distance.
        sliver: metres; shorter drawn edges count as that long, because a scan's decimation leaves slivers.
        beside: metres in the plane of the triangle that carries a vertex, from which this bridges an opening.
        drawn_margin: metres that drawn vertices keep from the skin, which comes through between particles.
        least_determinant: of a blend of rotations; below, its inverse would blow up what the cloth did.
        wander: metres of the root from the origin of the particles' places above which that follows it, because
            float32 loses precision with the distance.
        floor: height of the ground, metres of the world, on which cloth of who kneels, falls or lies comes to rest;
            None: there is none.
        solver: how time is stepped.
    """

    ramp: float = 0.7
    ramp_step: float = 1.0 / 30.0
    hold: float = 0.2
    longest_step: float = 0.26
    teleport: float = 12.0
    most_stretch: float = 4.0
    most_drawn: float = 1.5
    sliver: float = 0.005
    beside: float = 0.005
    drawn_margin: float = 0.002
    least_determinant: float = 0.2
    wander: float = 4.0
    floor: float | None = None
    solver: SolverConfig = field(default_factory=SolverConfig)

    def __post_init__(self) -> None:
        for name in ("ramp", "hold", "beside", "drawn_margin"):
            require_at_least(f"cloth driver: {name}", getattr(self, name), 0.0)
        positive = "ramp_step", "longest_step", "teleport", "most_stretch", "sliver", "least_determinant", "wander"
        for name in positive:
            require_positive(f"cloth driver: {name}", getattr(self, name))
        require_at_least("cloth driver: most_drawn", self.most_drawn, 1.0)


@dataclass(frozen=True, eq=False)
class ClothShape:
    """What cloth does in one pose.

    Attributes:
        vertices: L of the template's.
        displacements: metres along the axes of the T-pose, to be added before skinning.
        share: in [0, 1]: how much of a vertex's displacement this is; the rest stays what it would be without.
    """

    vertices: Int64[np.ndarray, " L"]
    displacements: Float32[np.ndarray, "L 3"]
    share: Float32[np.ndarray, " L"]

    __repr__ = one_line


class ClothDriver:
    """Steps garments of one template, the inner ones first; each touches the body and what it lies over.

    Args:
        template: the person.
        garments: cut from it.
        config: how motions are followed.

    Attributes:
        notes: remarks on restarts, gaps and failures, a sentence each, in order.
        quality: what was measured of each garment in the frames since it was made or since `measure_anew`.

    Raises:
        InputError: no garment, or one of another template.
    """

    def __init__(self, template: Template, garments: Sequence[Garment], config: DriverConfig | None = None) -> None:
        if not garments:
            raise InputError("loose parts to simulate", expected="at least one garment", received="none")
        self.template, self.config = template, config or DriverConfig()
        parts = list(template.part_names)
        unknown = [g.part for g in garments if g.part not in parts or g.vertices.max() >= template.vertex_count]
        if unknown:
            raise InputError(
                f"garment {unknown[0]!r}", expected="one that was cut from this template", received="another's"
            )
        self.notes: list[str] = []
        # Vertices of the template that steps need; the others are not posed.
        self._rows = np.unique(np.concatenate([np.r_[g.collider.vertices, g.particles] for g in garments]))
        self._fine = np.concatenate([g.vertices for g in garments])
        self._rows_skinned, self._fine_skinned = (SkinnedRows(template.weights, r) for r in (self._rows, self._fine))
        self._rest = template.vertices.astype(np.float32)
        # The same with the body's shape of the moment, where steps need it.
        self._shaped_rest = self._rest.copy()
        self._skin = self._rows[self._rows < template.body.vertex_count]
        self._threads = [
            GarmentThread(
                g, self._rows, self.config, template.faces, layered=any(_touch(g, other) for other in garments)
            )
            for g in garments
        ]
        self.quality = [ClothQuality(part=g.part) for g in garments]
        # What places are measured from: near the person, so that float32 knows micrometres wherever that stands.
        self._measure_from(np.zeros(3))
        self._time = 0.0
        self._last: BodyParams | None = None
        share = np.concatenate([g.share() for g in garments])
        self._shape = ClothShape(self._fine, np.zeros((len(self._fine), 3), np.float32), share)

    @property
    def garments(self) -> tuple[Garment, ...]:
        """Return the garments that are simulated."""
        return tuple(thread.garment for thread in self._threads)

    def particles(self, part: str) -> Float32[np.ndarray, "n 3"]:
        """Return where the particles of a part are, world, metres.

        Raises:
            InputError: no such part is simulated.
        """
        names = [garment.part for garment in self.garments]
        require_choice("simulated part", part, names)
        return (self._threads[names.index(part)].particles() + self._origin).astype(np.float32)

    def place(self, part: str, particles: Float32[np.ndarray, "n 3"]) -> None:
        """Put the particles of a part elsewhere, world, metres; their velocities stay.

        Raises:
            InputError: no such part is simulated, or another number of particles.
        """
        self._thread_of(part, particles).place((particles - self._origin).astype(np.float32))

    def draw_to(self, part: str, seen: Float[np.ndarray, "n 3"], seconds: float, *, gain: float = 0.7) -> None:
        """Draw the particles of a part towards where they were seen in the pose of the last step, and so their motion.

        Args:
            seen: world, metres; NaN where a particle was not seen.
            seconds: since the step or the drawing before.
            gain: in [0, 1], of the residual. On followed surfaces of training frames .5 to 1 predict the next twelve
                frames alike.

        Raises:
            InputError: no such part is simulated, another number of particles, no positive time, another gain.
        """
        thread = self._thread_of(part, seen)
        require_positive("seconds until particles are seen", seconds)
        require_between("gain of what is seen", gain, 0.0, 1.0)
        thread.draw_to(seen - self._origin, seconds, gain=gain)

    def _thread_of(self, part: str, particles: Float[np.ndarray, "n 3"]) -> GarmentThread:
        expected = self.particles(part).shape
        if particles.shape != expected:
            raise InputError(f"particles of {part}", expected=f"shape {expected}", received=str(particles.shape))
        return self._threads[[garment.part for garment in self.garments].index(part)]

    def measure_anew(self) -> None:
        """Forget what was measured: the frames until now are not used."""
        self.quality = [ClothQuality(part=one.part) for one in self.quality]

    def restart(self) -> None:
        """Forget the state: the next step starts cold."""
        self._last = None

    def step(self, params: BodyParams | None, seconds: float, *, posed: PosedBody | None = None) -> ClothShape:
        """Step the clothes to the next pose.

        The first one, one that lies `DriverConfig.longest_step` or more after the last, and one that what holds the
        cloth could not have reached start cold: a ramp leads there from the reference pose.

        Args:
            params: one frame; None: the pose is not known at this time, and the cloth stays as it is on the body.
            seconds: since the last step; of the first step it does not matter.
            posed: `template.posed_body(params)`, where the caller has it already.

        Raises:
            InputError: several frames, no positive time, parameters that the body refuses.
        """
        if params is None:
            self.notes.append(f"no pose after {self._time:.2f} s: the clothes stay as they are")
            return self._shape
        return self._shaped(self._stepped(params, seconds, posed))

    def _stepped(self, params: BodyParams, seconds: float, posed: PosedBody | None = None) -> PosedBody:
        """Step the particles to the next pose; return the body in it."""
        if len(params) != 1:
            raise InputError("pose of a step", expected="one frame", received=f"{len(params)} frames")
        posed = self.template.posed_body(params) if posed is None else posed
        # The very first pose has no state to continue from.
        if self._last is None:
            self._start(params, posed)
            return posed
        require_positive("seconds of a step", seconds)
        self._time += seconds
        if seconds > self.config.longest_step:
            self.notes.append(f"{seconds:.2f} s without a pose before {self._time:.2f} s: the clothes restart")
            self._start(params, posed)
        # A leap faster than the teleport speed is a cut in the motion: carrying the state across would tear the cloth.
        elif not self._advance(posed, seconds):
            self.notes.append(f"a leap at {self._time:.2f} s: the clothes restart")
            self._start(params, posed)
        self._last = params
        return posed

    def _start(self, params: BodyParams, posed: PosedBody) -> None:
        """Come to a first pose from the reference pose, where the cloth hangs as it was scanned."""
        # The reference is turned to face as the first pose does, so that the ramp does not whirl the cloth around.
        start = reference_facing_as(self._threads[0].garment.reference, params)
        ramp_step = self.config.ramp_step
        steps, still = (round(t / ramp_step) for t in (self.config.ramp, self.config.hold))
        self._measure_from(posed.joints[0, 0])
        places = self._places(self.template.posed_body(start) if steps else posed)
        for thread in self._threads:
            thread.reset(places)
        for k in range(1, steps):
            t = k / steps
            # The smoothstep 3 t^2 - 2 t^3 starts and ends without velocity, so the ramp gives the cloth no jolt.
            between = pose_between(start, params, t * t * (3.0 - 2.0 * t))
            self._advance(self.template.posed_body(between), ramp_step, at_any_speed=True)
        # Hold the first pose until the swing of the ramp has died down.
        for _ in range(still + min(steps, 1)):
            self._advance(posed, ramp_step, at_any_speed=True)
        # Contact cannot push out particles that start too deep; report them instead of failing.
        for thread in self._threads:
            thread.begin_measuring()
            if buried := thread.buried():
                self.notes.append(
                    f"{thread.garment.part} at {self._time:.2f} s: {buried} of {len(thread.garment.particles)} "
                    "particles start inside the body; they come out as it moves"
                )
        self._last = params

    def _advance(self, posed: PosedBody, seconds: float, *, at_any_speed: bool = False) -> bool:
        """Move all garments on to a pose; False, and nothing moved, where what holds them went too fast."""
        # Keep the origin near the person: float32 coordinates lose precision with their distance from it.
        away = posed.joints[0, 0] - self._origin
        if np.abs(away).max() > self.config.wander:
            self._measure_from(self._origin + away)
            for thread in self._threads:
                thread.shift(-away.astype(np.float32))
        places = self._places(posed)
        # Measure the fastest pin before any particle moves, so that a refusal leaves the state untouched.
        farthest = max(thread.way_to(places) for thread in self._threads)
        if farthest > self.config.teleport * seconds and not at_any_speed:
            return False
        # Inner garments move first, since the outer ones collide with their new surfaces.
        for thread in self._threads:
            note = thread.advance(places, seconds, self._threads)
            if note:
                self.notes.append(f"{thread.garment.part} at {self._time:.2f} s: {note}")
        return True

    def _measure_from(self, origin: Float[np.ndarray, " 3"]) -> None:
        """Take places from another origin, world, metres."""
        self._origin = np.array(origin)
        for thread in self._threads:
            thread.floor = None if self.config.floor is None else float(self.config.floor - origin[1])

    def _places(self, posed: PosedBody) -> Float32[np.ndarray, "R 3"]:
        """Return where skinning has the vertices that steps need, metres from the origin."""
        self._shaped_rest[self._skin] = posed.rest_vertices[0][self._skin]
        return self._rows_skinned.posed(posed, self._shaped_rest, origin=self._origin)

    def follow(
        self, poses: Sequence[BodyParams], seconds: float, drawn: BodyParams | None, *, posed: PosedBody | None = None
    ) -> ClothShape:
        """Go on along poses that are even in time, and return the cloth for the body that is drawn at their end.

        Args:
            poses: at least one frame, as `smplxpp.cloth.play.ways` yields them.
            seconds: of all of it.
            drawn: one frame; None: the last of the poses.
            posed: the drawn body, where it is there already.
        """
        for pose in poses[:-1]:
            self.step(pose, seconds / len(poses))
        last = self._stepped(poses[-1], seconds / len(poses))
        # The cloth is carried and measured once where it is drawn, for the body of the last pose or for another one.
        return self._shaped(last) if drawn is None else self.over(drawn, posed=posed)

    def over(self, params: BodyParams, *, posed: PosedBody | None = None) -> ClothShape:
        """Return the cloth where it hangs now, for a body that is drawn in another pose than the last step's.

        Between the pins and what hangs free, the change from one pose to the other is blended by `ClothShape.share`.

        Args:
            posed: the body in that pose, where it is there already.
        """
        return self._shaped(self.template.posed_body(params) if posed is None else posed)

    def _shaped(self, posed: PosedBody) -> ClothShape:
        """Take the cloth as it is back to the T-pose."""
        each = [thread.carried() for thread in self._threads]
        carried = np.concatenate(each)
        displacements = self._fine_skinned.unposed(
            posed, self._rest, carried, origin=self._origin, least_determinant=self.config.least_determinant
        )
        self._shape = ClothShape(self._fine, displacements, self._shape.share)
        self._measure(each)
        return self._shape

    def _measure(self, drawn: Sequence[Float32[np.ndarray, "N 3"]]) -> None:
        """Measure the garments as they are, and note the first frame in which one does not hold."""
        for k, thread in enumerate(self._threads):
            now, before = thread.measured(self._time, drawn[k]), self.quality[k]
            self.quality[k] = before.with_(now)
            if before.holds and not self.quality[k].holds:
                self.notes.append(f"the cloth tears at {self._time:.2f} s: {now.sentence}")


def _touch(one: Garment, other: Garment) -> bool:
    """Whether one of two garments lies over the other one."""
    over = any(np.isin(a.collider.vertices, b.vertices).any() for a, b in ((one, other), (other, one)))
    return one is not other and over
