"""What cloth is made of, and how its time is stepped."""

from __future__ import annotations

from dataclasses import dataclass

from smplxpp.core.validation import require_at_least, require_positive


@dataclass(frozen=True, kw_only=True)
class Fabric:
    """Parameters of a cloth material, in SI units.

    Attributes:
        density: kg a square metre.
        stretch_stiffness: N/m of a sheet that is pulled: an edge of length l between triangles of area A has the
            stiffness `stretch_stiffness A / l^2`.
        compression: share of it with which an edge resists being shortened; a thread buckles.
        bend_stiffness: N m: how strongly a hinge returns to its curvature at rest. 0: not at all, which saves a third
            of the time.
        slack: relative elongation of the path from an attachment that tethers allow.
        drag: of the air, 1/s.
        normal_drag: of what moves along its own normal, 1/s, on top.
        inner_friction: at which neighbours' velocities become alike, 1/s.
        friction: Coulomb's coefficient against the skin.
    """

    density: float = 0.22
    stretch_stiffness: float = 660.0
    compression: float = 0.16
    bend_stiffness: float = 1e-6
    slack: float = 0.0
    drag: float = 2.5
    normal_drag: float = 0.8
    inner_friction: float = 0.75
    friction: float = 0.15

    def __post_init__(self) -> None:
        for name in ("density", "stretch_stiffness", "compression"):
            require_positive(f"fabric: {name}", getattr(self, name))
        for name in ("bend_stiffness", "slack", "drag", "normal_drag", "inner_friction", "friction"):
            require_at_least(f"fabric: {name}", getattr(self, name), 0.0)


@dataclass(frozen=True, kw_only=True)
class SolverConfig:
    """Options of the time integration of the solver.

    Attributes:
        substep: seconds at most. Longer ones leave the cloth softer: corrections travel an edge a substep.
        contacts_every: substeps between two searches for contacts.
        own_margin: metres that particles of one garment keep from each other; 0: they may pass through each other.
        most_speed: metres a second; a safeguard, above what a garment does.
    """

    substep: float = 1.0 / 500.0
    contacts_every: int = 8
    own_margin: float = 0.0
    most_speed: float = 8.0

    def __post_init__(self) -> None:
        for name in ("substep", "most_speed"):
            require_positive(f"solver: {name}", getattr(self, name))
        require_at_least("solver: contacts_every", self.contacts_every, 1)
        require_at_least("solver: own_margin", self.own_margin, 0.0)
