"""A template's surface along a motion, its loose clothes simulated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from smplxpp.cloth.driver import ClothDriver, DriverConfig
from smplxpp.cloth.following import SMOOTHING, ways
from smplxpp.cloth.garment import Garment
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template


def play(
    template: Template,
    garments: Sequence[Garment],
    params: BodyParams,
    *,
    fps: float,
    config: DriverConfig | None = None,
    smoothing: float = SMOOTHING,
    notes: list[str] | None = None,
) -> Iterator[Float[np.ndarray, "V 3"]]:
    """Yield the posed surface of every frame, metres; the clothes start cold before the first one.

    Args:
        params: T frames, evenly spaced.
        fps: of them.
        config: of the driver.
        smoothing: of what the clothes follow (`smplxpp.cloth.following`), seconds.
        notes: list to which the remarks of the driver are added.
    """
    driver = ClothDriver(template, garments, config)
    weights = template.weights.dense()
    count = template.body.vertex_count
    for k, poses in enumerate(ways(params, fps, smoothing=smoothing)):
        frame = params.frame(k)
        posed = template.posed_body(frame)
        shape = driver.follow(poses, 1.0 / fps, frame, posed=posed)
        # Cloth is displaced at rest and then skinned: v = sum_j w_j G_j (rest + share displacement). The body's rest
        # vertices bring shape, expression and pose correctives.
        rest = template.vertices.copy()
        rest[:count] = posed.rest_vertices[0]
        rest[shape.vertices] += shape.share[:, None] * shape.displacements
        blended = (weights @ posed.posed_from_rest[0, :, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        if notes is not None:
            notes += driver.notes[len(notes) :]
        yield np.einsum("vij,vj->vi", blended[:, :, :3], rest) + blended[:, :, 3]
