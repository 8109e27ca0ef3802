"""Where the body carries a garment: what is tight at an opening, and what lies on the body from above."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from smplxpp.cloth.cloth_mesh import SHORTEST_OPENING, loop_length, opening_axis
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.topology import border_loops

# Metres from the skin up to which cloth is tight; a neckline or a cuff that holds lies within, a wide one does not.
TIGHT = 0.012
# Metres from the skin up to which an opening that looks up is held: under a shirt that falls over it there is the
# waistband that no scan shows.
WORN = 0.05
# Cosine to the vertical from which an opening looks up, and from which cloth that touches the body lies on it.
UP, LIES = 0.5, 0.5


def find_carriers(cloth: TriangleMesh, body: TriangleMesh) -> Bool[np.ndarray, " N"]:
    """Find the vertices of a garment that hold it, in the pose it was scanned in, +Y up.

    A garment hangs on its upper openings, a waistband or a neckline, on tight ones, and on what it covers from above,
    shoulders and the crown. A hem is an opening too, but looks down and is not tight; the median of an opening's
    distances decides. A garment that is torn from one opening to another has a single border: where nothing else holds
    it, what is tight of the border's upper half does.

    Args:
        cloth: N vertices, without bridges.
        body: the naked body in the same pose, closed or nearly.
    """
    # Signed distance to the body, metres; unreferenced vertices stay infinitely far.
    distance = np.full(cloth.vertex_count, np.inf)
    used = cloth.referenced
    distance[used] = SignedDistanceField(body, solid=True).query(cloth.vertices[used]).distance
    # Cloth that lies on the body from above, with a normal that looks up, is held by it.
    out = (distance < TIGHT) & (cloth.vertex_normals[:, 1] > LIES)
    for loop in border_loops(cloth.faces):
        if loop_length(cloth, loop) < SHORTEST_OPENING:
            continue
        # An opening that looks up is worn and may stand off farther; any other one holds only where it is tight.
        reach = WORN if opening_axis(cloth, loop)[1] > UP else TIGHT
        if float(np.median(distance[loop])) < reach:
            out[loop] = True
    # Nothing holds it and there is a border: the part torn from opening to opening hangs on the tight upper half of it.
    if not out.any() and len(border := np.unique(cloth.border_edges)):
        height = cloth.vertices[:, 1]
        middle = 0.5 * (height[used].min() + height[used].max())
        out[border] = (distance[border] < TIGHT) & (height[border] > middle)
    return out
