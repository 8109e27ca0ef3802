"""What of a session the browser shows in space: the scan, what is painted, landmarks, a box."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int64

from pipelines.viewer.doubtful import DoubtfulRegion
from pipelines.viewer.landmark_choice import lies_within
from pipelines.viewer.session import LabelSession
from pipelines.viewer.shapes import colored_glb, confidence_colors, label_colors, painted_glb

Mode = Literal["labels", "photograph", "confidence", "glass"]
MODES: tuple[Mode, ...] = ("labels", "photograph", "confidence", "glass")
_BASE, _PAINTED, _LIVE, _LANDMARKS = "/scan", "/painted", "/live", "/landmarks"
_LEFT, _RIGHT, _MIDDLE = (40, 150, 230), (235, 120, 40), (250, 220, 60)
_MARK, _GIZMO = 0.008, 0.12
_FIELD = np.radians(40.0)


class ScanScene:
    """The scene of one server.

    Args:
        server: viser's. session: what is shown at first.
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
            of_faces = label_colors(session.labels()) if mode == "labels" else confidence_colors(session.confidence())
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

    def look_at(self, region: DoubtfulRegion) -> None:
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
        """Turn all cameras to the whole scan, from the front turned by so many degrees."""
        angle = np.radians(side)
        self.look_from(self.center, np.array([np.sin(angle), 0.0, np.cos(angle)]), 1.6 * self._height)

    def _add_faces(
        self, group: str, session: LabelSession, faces: Int64[np.ndarray, " n"], labels: Int64[np.ndarray, " n"]
    ) -> None:
        nodes = self._nodes.setdefault(group, [])
        glb = painted_glb(session.scan.mesh, faces, label_colors(labels))
        nodes.append(self._server.scene.add_glb(f"{group}/{len(nodes)}", glb))

    def _clear(self, group: str) -> None:
        for node in self._nodes.pop(group, []):
            node.remove()
