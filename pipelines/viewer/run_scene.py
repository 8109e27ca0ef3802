"""Draw a run in the browser's 3D scene: layers, Gaussians, the tracked surface, photographs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from scipy.spatial.transform import Rotation

from pipelines.viewer.run_session import Coloring, Layer, RunSession
from pipelines.viewer.scene import colored_glb
from smplxpp.core import Camera, TriangleMesh

SPLATS, TRACKED, PHOTOGRAPHS = "/gaussians", "/tracked", "/photographs"
_FIELD = np.radians(40.0)
_PICTURE = 220  # pixels of a photograph's longer side
_GREY = (205, 205, 212)


class RunScene:
    """Scene of one viser server.

    Args:
        server: the server.
        session: session that is shown first.
    """

    def __init__(self, server: Any, session: RunSession) -> None:
        self._server, self._layers = server, session.layers
        self._nodes: dict[str, Any] = {}
        self._frusta: list[tuple[Camera, Any]] = []
        vertices = session.vertices()
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.center, self._height = 0.5 * (low + high), float(high[1] - low[1])
        server.scene.set_up_direction("+y")
        server.scene.configure_default_lights(cast_shadow=False)
        camera = server.initial_camera
        camera.fov = float(_FIELD)
        camera.look_at = tuple(self.center)
        camera.position = tuple(self._front)

    @property
    def _front(self) -> Float[np.ndarray, " 3"]:
        return self.center + np.array([0.0, 0.05, 1.6]) * self._height

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the visible nodes."""
        return tuple(name for name, node in self._nodes.items() if node.visible)

    @property
    def eye(self) -> Float[np.ndarray, " 3"]:
        """Return the eye point: that of the first window's camera, or one in front of the person."""
        for client in self._server.get_clients().values():
            return np.array(client.camera.position)
        return self._front

    def draw_layers(self, session: RunSession, shown: set[str], coloring: Coloring, joint: str) -> None:
        """Draw those layers of the template that are shown."""
        if not shown:
            for layer in self._layers:
                self._hide(_path(layer))
            return
        vertices, colors = session.vertices(), session.colors(coloring, joint)
        for layer in self._layers:
            if layer.name in shown:
                mesh = TriangleMesh(vertices[layer.vertices], layer.faces)
                self._glb(_path(layer), colored_glb(mesh, vertex_colors=colors[layer.vertices]))
            else:
                self._hide(_path(layer))

    def draw_splats(self, session: RunSession, *, shown: bool) -> None:
        """Draw the Gaussians of the session."""
        splats = session.splats(self.eye) if shown else None
        if splats is None:
            self._hide(SPLATS)
            return
        # One node a pose: its buffer's size may change with the model.
        self._nodes[SPLATS] = self._server.scene.add_gaussian_splats(
            SPLATS, splats.means, splats.covariances, splats.colors, splats.opacities
        )

    def draw_tracked(self, session: RunSession, *, shown: bool) -> None:
        """Draw the tracked surface in grey."""
        vertices = session.tracked_vertices() if shown else None
        if vertices is None:
            self._hide(TRACKED)
            return
        grey = np.full((len(vertices), 3), _GREY, dtype=np.uint8)
        mesh = TriangleMesh(np.asarray(vertices, dtype=np.float64), session.template.faces)
        self._glb(TRACKED, colored_glb(mesh, vertex_colors=grey))

    def draw_photographs(self, session: RunSession, *, shown: bool) -> None:
        """Draw the frame's photographs where their cameras stood; a click on one looks through its camera."""
        for _, node in self._frusta:
            node.remove()
        self._frusta = []
        capture = session.capture
        if not shown or capture is None or not session.motion.photographed:
            return
        for name, camera in capture.cameras.items():
            if camera.orthographic or capture.file(name, session.frame) is None:
                continue
            # The vertical field of view of a pinhole is 2 atan(h / (2 f_y)), f_y and h in pixels.
            image = _small(capture.image(name, session.frame))
            node = self._server.scene.add_camera_frustum(
                f"{PHOTOGRAPHS}/{name}",
                fov=2.0 * np.arctan(0.5 * camera.height / camera.K[1, 1]),
                aspect=camera.width / camera.height,
                scale=0.08 * self._height,
                thickness=0.002 * self._height,
                image=image,
                format="jpeg",
                wxyz=_wxyz(camera),
                position=tuple(camera.position),
            )
            node.on_click(self._look_through(camera))
            self._frusta.append((camera, node))

    @property
    def photographs(self) -> int:
        """Return the number of photographs in the scene."""
        return len(self._frusta)

    def step_back(self) -> None:
        """Move all windows' cameras back, until the photographs are before them."""
        if not self._frusta:
            return
        away = max(float(np.linalg.norm(camera.position - self.center)) for camera, _ in self._frusta)
        place = self.center + 2.2 * away * np.array([0.35, 0.45, 0.82])
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position, client.camera.look_at = tuple(place), tuple(self.center)

    def _look_through(self, camera: Camera) -> Callable[[Any], None]:
        def look(event: Any) -> None:
            with event.client.atomic():
                event.client.camera.wxyz = _wxyz(camera)
                event.client.camera.position = tuple(camera.position)
                event.client.camera.fov = float(2.0 * np.arctan(0.5 * camera.height / camera.K[1, 1]))

        return look

    def _glb(self, path: str, data: bytes) -> None:
        node = self._nodes.get(path)
        # A new node for every change would flicker in the browser: the data of the present one are exchanged.
        if node is None:
            self._nodes[path] = self._server.scene.add_glb(path, data)
        else:
            node.glb_data, node.visible = data, True

    def _hide(self, path: str) -> None:
        if path in self._nodes:
            self._nodes[path].visible = False


def _path(layer: Layer) -> str:
    return f"/template/{layer.name}"


def _wxyz(camera: Camera) -> tuple[float, ...]:
    # The camera's orientation in the world is the inverse of cam_from_world; scipy has w last, viser first.
    turn = Rotation.from_matrix(np.asarray(camera.cam_from_world)[:3, :3].T).as_quat()
    return tuple(np.roll(turn, 1).tolist())


def _small(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
    picture = Image.fromarray(np.ascontiguousarray(image))
    picture.thumbnail((_PICTURE, _PICTURE))
    return np.asarray(picture)
