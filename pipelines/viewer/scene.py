"""What of a session the browser shows in space: the scan, what is painted, landmarks, a box; and what a ray hits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pygltflib
from jaxtyping import Float, Float64, Int64, UInt8
from pygltflib import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER

from pipelines.viewer.session import LabelSession, UncertainRegion, lies_within
from smplxpp.core import LABELS, Labels, TriangleMesh
from smplxpp.export.gltf import linear_rgba16
from smplxpp.export.gltf_buffers import BufferBuilder, index_dtype
from smplxpp.figures.colors import heat_colors
from smplxpp.segment.corrected_faces import ScanSurface


def confidence_colors(confidence: Float64[np.ndarray, " M"]) -> UInt8[np.ndarray, "M 3"]:
    """Return colours of confidence: pale where it is high, dark red where it is low."""
    return heat_colors(1.0 - confidence, cmap="error", limits=(0.0, 1.0))


def colored_glb(
    mesh: TriangleMesh,
    *,
    face_colors: UInt8[np.ndarray, "M 3"] | None = None,
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None,
) -> bytes:
    """A GLB of a mesh with colours of its faces or its vertices, dull as cloth, seen from both sides."""
    # Scans with more faces are drawn with vertex colours, because separate corners for every face would take too
    # long.
    most_split_faces = 250_000
    if face_colors is not None and mesh.face_count <= most_split_faces:
        corners = np.arange(3 * mesh.face_count).reshape(-1, 3)
        rows = mesh.faces.reshape(-1)
        return _glb(mesh.vertices[rows], mesh.vertex_normals[rows], np.repeat(face_colors, 3, axis=0), corners)
    if face_colors is not None:
        vertex_colors = np.zeros((mesh.vertex_count, 3), dtype=np.uint8)
        vertex_colors[mesh.faces] = face_colors[:, None]
    assert vertex_colors is not None, "one of both is given"
    return _glb(mesh.vertices, mesh.vertex_normals, vertex_colors, mesh.faces)


def painted_glb(mesh: TriangleMesh, faces: Int64[np.ndarray, " n"], colors: UInt8[np.ndarray, "n 3"]) -> bytes:
    """A GLB of some of a mesh's faces in these colours, a little above it."""
    lift = 0.0007  # distance of painted faces above the scan, metres, against flickering depth
    rows = mesh.faces[faces].reshape(-1)
    normals = mesh.vertex_normals[rows]
    corners = np.arange(len(rows)).reshape(-1, 3)
    return _glb(mesh.vertices[rows] + lift * normals, normals, np.repeat(colors, 3, axis=0), corners)


def _glb(vertices: np.ndarray, normals: np.ndarray, colors: np.ndarray, faces: np.ndarray) -> bytes:
    gltf = pygltflib.GLTF2(asset=pygltflib.Asset(version="2.0"))
    buffers = BufferBuilder(gltf)
    attributes = pygltflib.Attributes(
        POSITION=buffers.add(vertices.astype(np.float32), target=ARRAY_BUFFER, bounds=True),
        NORMAL=buffers.add(normals.astype(np.float32), target=ARRAY_BUFFER),
        COLOR_0=buffers.add(linear_rgba16(colors), target=ARRAY_BUFFER, normalized=True),
    )
    indices = buffers.add(faces.reshape(-1).astype(index_dtype(len(vertices))), target=ELEMENT_ARRAY_BUFFER)
    dull = pygltflib.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=1.0)
    gltf.materials = [pygltflib.Material(pbrMetallicRoughness=dull, doubleSided=True)]
    gltf.meshes = [pygltflib.Mesh(primitives=[pygltflib.Primitive(attributes=attributes, indices=indices, material=0)])]
    gltf.nodes, gltf.scenes, gltf.scene = [pygltflib.Node(mesh=0)], [pygltflib.Scene(nodes=[0])], 0
    return buffers.glb()


def legend(labels: Int64[np.ndarray, " M"], areas: Float64[np.ndarray, " M"], known: Labels = LABELS) -> str:
    """The labels, their colours and shares of the surface, as HTML."""
    share = np.bincount(labels, areas, minlength=len(known)) / areas.sum()
    rows = (
        f'<div style="display:flex;gap:.5em;align-items:center"><span style="width:1em;height:1em;border-radius:.2em;'
        f'background:rgb{label.display_rgb}"></span><span style="flex:1">{label.name}</span>'
        f"<span>{100 * share[label.id]:.1f} %</span></div>"
        for label in known
    )
    return f'<div style="padding:0 .8em .4em .8em;font-size:.85em">{"".join(rows)}</div>'


Mode = Literal["labels", "photograph", "confidence", "glass"]
MODES: tuple[Mode, ...] = ("labels", "photograph", "confidence", "glass")
_BASE, _PAINTED, _LIVE, _LANDMARKS = "/scan", "/painted", "/live", "/landmarks"
_LEFT, _RIGHT, _MIDDLE = (40, 150, 230), (235, 120, 40), (250, 220, 60)
_MARK, _GIZMO = 0.008, 0.12
_FIELD = np.radians(40.0)


class ScanScene:
    """Scene of one viser server.

    Args:
        server: the server.
        session: session that is shown first.
    """

    def __init__(self, server: Any, session: LabelSession) -> None:
        self._server, self._nodes = server, dict[str, list[Any]]()
        vertices = session.scan.mesh.vertices
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.center, self._height = 0.5 * (low + high), float(high[1] - low[1])
        server.scene.set_up_direction("+y")
        server.scene.configure_default_lights(cast_shadow=False)
        camera = server.initial_camera
        camera.fov = float(_FIELD)
        camera.look_at = tuple(self.center)
        camera.position = tuple(self.center + [0.0, 0.05 * self._height, 1.6 * self._height])

    def draw_scan(self, session: LabelSession, mode: Mode) -> Any:
        """Draw the scan itself; returns the node that pointers hit."""
        mesh = session.scan.mesh
        if mode == "glass":
            node = self._server.scene.add_mesh_simple(
                _BASE, mesh.vertices, mesh.faces, color=(200, 205, 215), opacity=0.45, side="double"
            )
        elif mode == "photograph" or not session.has_labels:
            node = self._server.scene.add_glb(_BASE, colored_glb(mesh, vertex_colors=session.scan.colors))
        else:
            colors = session.scan.known.display_colors
            of_faces = colors(session.labels()) if mode == "labels" else confidence_colors(session.confidence())
            node = self._server.scene.add_glb(_BASE, colored_glb(mesh, face_colors=of_faces))
        return node

    def draw_painted(self, session: LabelSession, *, shown: bool) -> None:
        """Draw what is corrected above the scan, which keeps the colours that it was drawn with."""
        self._clear(_PAINTED)
        if not shown or not session.has_labels:
            return
        faces = np.flatnonzero(session.corrected())
        if len(faces):
            self._add_faces(_PAINTED, session, faces, session.labels()[faces])

    def draw_live(self, session: LabelSession, faces: Int64[np.ndarray, " n"], label: int) -> None:
        """Draw what a brush passes over while it does."""
        if len(faces):
            self._add_faces(_LIVE, session, faces, np.full(len(faces), label))

    def clear_live(self) -> None:
        """Remove what a brush has passed over."""
        self._clear(_LIVE)

    def draw_landmarks(self, session: LabelSession, chosen: str | None) -> Any | None:
        """Draw the landmarks; returns the gizmo of the chosen one, if it is placed."""
        self._clear(_LANDMARKS)
        gizmo = None
        for name, point in session.landmarks.items():
            color = _LEFT if name.startswith("left_") else _RIGHT if name.startswith("right_") else _MIDDLE
            place, path = tuple(point.tolist()), f"{_LANDMARKS}/{name}"
            scene = self._server.scene
            nodes = [scene.add_icosphere(f"{path}/point", radius=_MARK, color=color, subdivisions=2, position=place)]
            words = f"{name} (within)" if lies_within(name) else name
            nodes.append(scene.add_label(f"{path}/name", words, position=place, font_screen_scale=0.8))
            if name == chosen:
                gizmo = scene.add_transform_controls(
                    f"{path}/gizmo", scale=_GIZMO, disable_rotations=True, depth_test=False, position=place
                )
                nodes.append(gizmo)
            self._nodes.setdefault(_LANDMARKS, []).extend(nodes)
        return gizmo

    def draw_box(
        self, center: Float[np.ndarray, " 3"], size: Float[np.ndarray, " 3"], color: tuple[int, int, int]
    ) -> tuple[Any, Any]:
        """Draw a box and the gizmo that moves and turns it."""
        scene, place = self._server.scene, tuple(np.asarray(center).tolist())
        gizmo = scene.add_transform_controls("/box", scale=0.25, depth_test=False, position=place)
        dimensions = tuple(np.asarray(size).tolist())
        return gizmo, scene.add_box("/box/shape", dimensions=dimensions, color=color, opacity=0.35)

    def look_at(self, region: UncertainRegion) -> None:
        """Turn all cameras to a region, from the front of it and half a metre away."""
        self.look_from(region.center, region.normal, max(0.5, 4.0 * float(np.sqrt(region.area))))

    def look_from(self, target: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"], distance: float) -> None:
        """Turn all cameras to a point."""
        # Straight from above or below a camera has no upright.
        aside = direction * [1.0, 0.4, 1.0] if abs(direction[1]) < 0.95 else np.array([0.0, 0.4 * direction[1], 1.0])
        position = target + distance * aside / np.linalg.norm(aside)
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position = tuple(position)
                client.camera.look_at = tuple(np.asarray(target))

    def look_at_whole(self, side: float) -> None:
        """Turn all cameras to the whole scan, from the front rotated by `side` degrees."""
        angle = np.radians(side)
        self.look_from(self.center, np.array([np.sin(angle), 0.0, np.cos(angle)]), 1.6 * self._height)

    def _add_faces(
        self, group: str, session: LabelSession, faces: Int64[np.ndarray, " n"], labels: Int64[np.ndarray, " n"]
    ) -> None:
        nodes = self._nodes.setdefault(group, [])
        glb = painted_glb(session.scan.mesh, faces, session.scan.known.display_colors(labels))
        nodes.append(self._server.scene.add_glb(f"{group}/{len(nodes)}", glb))

    def _clear(self, group: str) -> None:
        for node in self._nodes.pop(group, []):
            node.remove()


@dataclass(frozen=True, eq=False)
class Hit:
    """Intersection of a ray with a scan.

    Attributes:
        face: number of the face.
        point: intersection, metres.
        normal: normal of the face, on the side of the ray's origin.
        distance: distance from the ray's origin, metres.
    """

    face: int
    point: Float64[np.ndarray, " 3"]
    normal: Float64[np.ndarray, " 3"]
    distance: float


def hits(surface: ScanSurface, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]) -> list[Hit]:
    """Return all intersections of a ray with the scan, nearest first."""
    start = np.ascontiguousarray(origin, dtype=np.float64)
    along = np.asarray(direction, dtype=np.float64)
    along = np.ascontiguousarray(along / np.linalg.norm(along))
    mesh = surface.mesh
    (met,) = surface.tree.intersect_ray(mesh.vertices, mesh.faces, start[None], along[None])
    found = sorted((float(one[1]), int(one[0])) for one in met if one[1] > 0)
    out = []
    for distance, face in found:
        normal = mesh.face_normals[face]
        out.append(Hit(face, start + distance * along, -normal if normal @ along > 0 else normal, distance))
    return out


def first_hit(surface: ScanSurface, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]) -> Hit | None:
    """Return the nearest intersection, or None if the ray misses the scan."""
    found = hits(surface, origin, direction)
    return found[0] if found else None


def middle_of_limb(
    surface: ScanSurface, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]
) -> Float64[np.ndarray, " 3"] | None:
    """Return the middle between a ray's entry into a limb and its exit, which is about the joint's centre.

    The exit is the first face behind the entry that faces away from the ray's origin. None if the ray misses or does
    not exit, as in a scan that is open at the back.
    """
    found = hits(surface, origin, direction)
    along = np.asarray(direction, dtype=np.float64)
    for one in found[1:]:
        if surface.mesh.face_normals[one.face] @ along > 0:
            return 0.5 * (found[0].point + one.point)
    return None


def line_under(
    surface: ScanSurface,
    origin: Float[np.ndarray, " 3"],
    places: Float[np.ndarray, "n 3"],
    radius: float,
) -> list[tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3"]]]:
    """Return points and normals of the scan under a dragged pointer.

    Args:
        surface: the scan.
        origin: centre of the camera.
        places: positions of the pointer, on any plane before the camera.
        radius: radius of the brush, metres.

    Returns:
        A line for each piece of surface: a new one begins where the pointer leaves the scan or jumps to a limb behind.
    """
    # A jump of more than two radii (at least 3 cm) is another piece of surface. Points within a fifth of the radius add
    # nothing and are dropped; lines of 2,000 points are continued in a new one.
    lines: list[list[Hit]] = []
    last: Hit | None = None
    for place in _between(np.asarray(places, dtype=np.float64), radius):
        hit = first_hit(surface, origin, place - origin)
        if hit is None:
            last = None
            continue
        step = np.inf if last is None else float(np.linalg.norm(hit.point - last.point))
        if step > max(2.0 * radius, 0.03):
            lines.append([hit])
        elif len(lines[-1]) >= 2000:
            lines.append([lines[-1][-1], hit])
        elif np.linalg.norm(hit.point - lines[-1][-1].point) > 0.2 * radius:
            lines[-1].append(hit)
        last = hit
    return [(np.stack([hit.point for hit in line]), np.stack([hit.normal for hit in line])) for line in lines]


def _between(places: Float64[np.ndarray, "n 3"], radius: float) -> Float64[np.ndarray, "m 3"]:
    """Return places at most half a radius apart, at most 64 between two positions of the pointer."""
    if len(places) == 1:
        return places
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    counts = np.clip(np.ceil(2.0 * steps / radius), 1, 64).astype(int)
    parts = [
        places[k] + np.arange(count)[:, None] / count * (places[k + 1] - places[k]) for k, count in enumerate(counts)
    ]
    return np.concatenate([*parts, places[-1:]])
