"""Draw a run in the browser's 3D scene, and make its labels again."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from scipy.spatial.transform import Rotation

from pipelines.runs.artefacts import load_labels, load_scan, load_scan_labels, read_named, take, values_of
from pipelines.runs.layout import (
    CORRECTIONS_FILE,
    LANDMARKS_FILE,
    RECONSTRUCT_FILE,
    REGISTER_FILE,
    SCAN,
    SCAN_LABELS,
    SEGMENT_STAGE,
)
from pipelines.stages.build import build
from pipelines.stages.build_config import load_build, load_reconstruct, load_register
from pipelines.viewer.run_session import Coloring, Layer, RunSession
from pipelines.viewer.scene import colored_glb
from pipelines.viewer.session import LabelledScan, LabelSession
from smplxpp.build.prepare import GREY
from smplxpp.build.scan import read_scan
from smplxpp.core import Camera, TriangleMesh
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.files import as_numbers, read_arrays
from smplxpp.register import read_landmarks
from smplxpp.segment import Corrections


def open_session(run: Path) -> LabelSession:
    """The scan of a run, its labels before any correction, and the corrections and landmarks that lie in the run.

    A run whose build stopped before its scan was kept has the scan that it was to be built from, and no labels: there
    landmarks can be placed.

    Raises:
        InputError: no run, or one without any scan.
    """
    corrections, landmarks = run / CORRECTIONS_FILE, run / LANDMARKS_FILE
    return LabelSession(
        _labelled_scan(run),
        Corrections.load(corrections, labels=load_labels(run)) if corrections.exists() else None,
        read_landmarks(landmarks) if landmarks.exists() else None,
    )


def _labelled_scan(run: Path) -> LabelledScan:
    if not (run / SCAN).is_file():
        return _unbuilt_scan(run)
    mesh, colors, _ = load_scan(run)
    if not (run / SCAN_LABELS).is_file():
        return LabelledScan(mesh, colors, None, None)
    labels = load_scan_labels(run, mesh.face_count)
    (confidence,) = read_named(run / SCAN_LABELS, "confidence")
    with values_of(run / SCAN_LABELS):
        confidence = as_numbers(confidence, (mesh.face_count,), subject="confidence")
    before = read_arrays(run / SCAN_LABELS, subject="stage file")
    # Corrections by hand are applied to the labels that the stage found, not to those with earlier corrections.
    if "labels_before_hand" in before:
        found = take(before, "labels_before_hand", "confidence_before_hand", path=run / SCAN_LABELS)
        with values_of(run / SCAN_LABELS):
            confidence = as_numbers(
                found["confidence_before_hand"], (mesh.face_count,), subject="confidence_before_hand"
            )
            labels = _before_hand(found["labels_before_hand"], mesh.face_count)
    return LabelledScan(mesh, colors, labels.astype(np.int64), confidence, load_labels(run))


def _before_hand(labels: np.ndarray, faces: int) -> np.ndarray:
    """Labels as the stage had them before corrections.

    Raises:
        InputError: others than a whole number a face.
    """
    if labels.dtype.kind not in "iu" or labels.shape != (faces,):
        raise InputError(
            "labels_before_hand", expected=f"{faces} whole numbers", received=f"{labels.dtype} {labels.shape}"
        )
    return labels


def _unbuilt_scan(run: Path) -> LabelledScan:
    found = load_build(run) if run.is_dir() else None
    if found is None:
        raise InputError(
            f"run {run}",
            expected="a run of `smplxpp build` with a scan",
            received="a folder without one" if run.is_dir() else "no such folder",
            remedy="build it first: `smplxpp build RUN --scan SCAN`; a build that stops is enough",
        )
    inputs, config = found
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # told by the build
        scan = read_scan(inputs.scan_file, units=config.units, up=config.up, height=config.height)
    raw, clean = scan.raw, scan.clean
    colors = np.full((len(raw.vertices), 3), GREY, np.uint8) if raw.vertex_colors is None else raw.vertex_colors
    return LabelledScan(clean.mesh, np.asarray(colors[clean.source_vertex], dtype=np.uint8), None, None)


def label_again(run: Path, *, progress: Callable[[str, bool], None] = lambda name, done: None) -> LabelSession:
    """Run the stage of a run's labels again, with the corrections that lie in it, and open what comes out.

    Raises:
        InputError: the run does not say what it was built from, or the stage refuses.
    """
    found = load_build(run)
    if found is None:
        raise InputError(
            f"run {run}",
            expected="what it was built from (build.json)",
            received="nothing of the kind",
            remedy="give `smplxpp build` again",
        )
    inputs, config = found
    # A build that registers or reconstructs needs the inputs of these stages too, to find them up to date.
    registration = load_register(run) if inputs.registers else None
    reconstruction = load_reconstruct(run) if inputs.reconstructs else None
    lacks = (registration is None and inputs.registers, reconstruction is None and inputs.reconstructs)
    if any(lacks):
        name = REGISTER_FILE if lacks[0] else RECONSTRUCT_FILE
        raise InputError(
            f"run {run}",
            expected=f"what it was made from ({name})",
            received="nothing of the kind",
            remedy="give `smplxpp build` again",
        )
    build(
        run,
        inputs,
        config,
        registration=registration,
        reconstruction=reconstruction,
        first=SEGMENT_STAGE,
        last=SEGMENT_STAGE,
        progress=progress,
    )
    return open_session(run)


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
