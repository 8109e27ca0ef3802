"""OBJ files with a group for each part."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smplxpp.core.atomic import atomic_write_text
from smplxpp.core.errors import InputError
from smplxpp.core.template import Template


def write_obj(path: str | Path, template: Template, *, vertices: np.ndarray | None = None) -> None:
    """Write the template as OBJ, whole or not at all: one group a part, vertex order kept, colours after positions.

    Args:
        path: of the file.
        template: what to write.
        vertices: (V, 3) positions instead of the T-pose, for instance one frame of `template.pose`.

    Raises:
        InputError: positions that do not fit the template.
    """
    points = template.vertices if vertices is None else np.asarray(vertices, dtype=np.float64)
    if points.shape != template.vertices.shape or not np.isfinite(points).all():
        raise InputError(
            "OBJ vertices", expected=f"finite {template.vertices.shape}", received=f"shape {points.shape} or NaN"
        )
    rows = np.concatenate([points, template.vertex_colors / 255.0], axis=1)
    lines = ["# metres, +Y up; colours sRGB"]
    # Nine decimals are a nanometre.
    lines += [f"v {x:.9f} {y:.9f} {z:.9f} {r:.4f} {g:.4f} {b:.4f}" for x, y, z, r, g, b in rows.tolist()]
    for name in template.part_names:
        lines.append(f"g {name}")
        lines += [f"f {i} {j} {k}" for i, j, k in (template.faces[template.part_faces(name)] + 1).tolist()]
    atomic_write_text(path, "\n".join(lines) + "\n")
