"""Extended position-based dynamics of cloth (Macklin et al. 2016) with small steps (Macklin et al. 2019).

A tick (1/60 s by default) finds contacts once and runs substeps. Each substep moves the particles by their velocities,
then corrects positions once: edges (Gauss-Seidel over colours), hinges (all at once), springs to the body, tethers,
contacts. Velocities follow from the positions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_matrix, csr_matrix, diags

from pipelines.synth.cloth_model import ClothModel, hinge_normals
from pipelines.synth.contact import Contacts
from smplxpp.core.mesh import row_lengths

# Normals of hinges turn slowly: they are renewed every so many substeps.
_BEND_NORMALS_EVERY = 4

GRAVITY = np.array([0.0, -9.81, 0.0])

# Points at the start and at the end of a tick.
Ends = tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]


@dataclass(frozen=True)
class SolverConfig:
    """How time is stepped.

    Attributes:
        substeps: of a tick.
        drag: air drag, 1/s.
        smoothing: share of the difference to the neighbours' mean velocity that a tick takes away: inner friction.
        friction: Coulomb's coefficient against the skin.
        max_speed: metres a second; a safeguard, far above what a garment does.
    """

    substeps: int = 12
    drag: float = 0.8
    smoothing: float = 0.15
    friction: float = 0.3
    max_speed: float = 6.0


@dataclass(frozen=True, eq=False)
class Tick:
    """What moves the cloth during one tick: values at its start and its end.

    Attributes:
        seconds: its length.
        places: where the particles would be on the body.
        contacts: each with its surface's vertices at both ends; the last has the last word.
    """

    seconds: float
    places: Ends
    contacts: list[tuple[Contacts, Ends]]


class ClothSolver:
    """Holds the state of the particles, `position` and `velocity` (N, 3), and moves it on; they start at rest."""

    def __init__(
        self, model: ClothModel, position: Float[np.ndarray, "N 3"], config: SolverConfig | None = None
    ) -> None:
        self.model, self.config = model, config or SolverConfig()
        self.position = np.array(position, dtype=np.float64)
        self.velocity = np.zeros_like(self.position)
        self._mean = _neighbour_mean(model)
        self._tied = np.flatnonzero(np.isfinite(model.tether) & ~model.fixed)
        self._sprung = np.flatnonzero(np.isfinite(model.attach_compliance) & ~model.fixed)
        self._edge_masses = [model.inverse_mass[edges] for edges, _ in model.colors]

    def advance(self, tick: Tick) -> None:
        """Move the cloth through one tick."""
        config, model = self.config, self.model
        h = tick.seconds / config.substeps
        fixed = np.flatnonzero(model.fixed)
        decay = np.exp(-config.drag * h)
        self.velocity += config.smoothing * (self._mean @ self.velocity - self.velocity)
        for k in range(config.substeps):
            t0, t1 = k / config.substeps, (k + 1) / config.substeps
            place = _between(tick.places, t1)
            previous = self.position
            x = previous + h * (decay * self.velocity + h * GRAVITY)
            x[fixed] = place[fixed]
            self._stretch(x, h)
            if k % _BEND_NORMALS_EVERY == 0:
                normal = self._hinge_normals(x)
            self._bend(x, normal, h)
            self._attach(x, place, h)
            self._tether(x)
            for contacts, surface in tick.contacts:
                contacts.resolve(x, previous, (_between(surface, t0), _between(surface, t1)), config.friction)
            x[fixed] = place[fixed]
            velocity = (x - previous) / h
            speed = row_lengths(velocity)[:, None]
            self.velocity = velocity * np.minimum(1.0, config.max_speed / np.maximum(speed, 1e-9))
            self.position = x

    def _stretch(self, x: Float[np.ndarray, "N 3"], h: float) -> None:
        compliance = self.model.stretch_compliance / h**2
        for (edges, rest), mass in zip(self.model.colors, self._edge_masses, strict=True):
            a, b = x.take(edges[:, 0], axis=0), x.take(edges[:, 1], axis=0)
            d = a - b
            length = np.sqrt(np.einsum("ei,ei->e", d, d))
            scale = (length - rest) / (np.maximum(length, 1e-9) * (mass[:, 0] + mass[:, 1] + compliance))
            d *= scale[:, None]
            x[edges[:, 0]] = a - mass[:, :1] * d
            x[edges[:, 1]] = b + mass[:, 1:] * d

    def _hinge_normals(self, x: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "H 3"]:
        corners = self.model.rest.faces
        a = x.take(corners[:, 0], axis=0)
        normals = _cross(x.take(corners[:, 1], axis=0) - a, x.take(corners[:, 2], axis=0) - a)
        normals *= (1.0 / np.maximum(row_lengths(normals), 1e-12))[:, None]
        return hinge_normals(normals, self.model.hinges.faces)

    def _bend(self, x: Float[np.ndarray, "N 3"], normal: Float[np.ndarray, "H 3"], h: float) -> None:
        hinges = self.model.hinges
        error = np.einsum("hi,hi->h", hinges.operator @ x, normal) - hinges.rest
        x -= hinges.gather @ ((error / (hinges.weight + hinges.compliance / h**2))[:, None] * normal)

    def _attach(self, x: Float[np.ndarray, "N 3"], place: Float[np.ndarray, "N 3"], h: float) -> None:
        at, mass = self._sprung, self.model.inverse_mass[self._sprung]
        gain = mass / (mass + self.model.attach_compliance[at] / h**2)
        x[at] += gain[:, None] * (place[at] - x[at])

    def _tether(self, x: Float[np.ndarray, "N 3"]) -> None:
        at = self._tied
        d = x[at] - x[self.model.anchor[at]]
        length = row_lengths(d)
        over = np.maximum(length - self.model.tether[at], 0.0) / np.maximum(length, 1e-9)
        x[at] -= over[:, None] * d


def _between(ends: Ends, t: float) -> Float[np.ndarray, "N 3"]:
    return (1.0 - t) * ends[0] + t * ends[1]


def _cross(a: Float[np.ndarray, "N 3"], b: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Return what np.cross returns, without its bookkeeping."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def _neighbour_mean(model: ClothModel) -> csr_matrix:
    """Make the (N, N) mean over the neighbours along edges."""
    edges, n = model.rest.edges, model.rest.vertex_count
    ends = np.concatenate([edges, edges[:, ::-1]]).T
    adjacency = coo_matrix((np.ones(ends.shape[1]), tuple(ends)), shape=(n, n)).tocsr()
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    return csr_matrix(diags(1.0 / np.maximum(degree, 1.0)) @ adjacency)
