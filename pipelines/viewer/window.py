"""The window of `smplxpp label`: controls beside the scene, and what a pointer on the scan does."""

from __future__ import annotations

import logging
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pipelines.viewer.run_scene import label_again
from pipelines.viewer.scene import MODES, ScanScene, first_hit, legend, line_under, middle_of_limb
from pipelines.viewer.server import address_of, one_at_a_time, plain_markdown, start_server, stop_server
from pipelines.viewer.session import CHOICE, LabelSession, UncertainRegion, lies_within, uncertain_regions
from smplxpp.core.labels import UPPER, Labels
from smplxpp.segment.corrected_faces import stroked_faces

log = logging.getLogger(__name__)
BRUSH, PATCH, BOX, LANDMARK = "brush", "patch", "box", "landmark"
_HELP = {
    BRUSH: "**Shift + drag** paints, **Shift + click** dabs.",
    PATCH: "**Shift + click** gives a whole patch the label.",
    BOX: "**Shift + click** puts the box there; drag its arrows and rings; then *label what is in the box*.",
    LANDMARK: "**Shift + click** places the landmark; drag its arrows to move it. Joints go into the middle of the "
    "limb under the pointer. Left is the person's left.",
}
_NONE = "none"


def open_window(session: LabelSession, run: Path, *, host: str = "127.0.0.1", port: int = 8080) -> LabelWindow:
    """Start a server with the window of a session; `LabelWindow.close` ends it.

    Raises:
        MissingExtraError: viser is not installed.
    """
    server = start_server("smplxpp label", host=host, port=port)
    return LabelWindow(server, session, run)


class LabelWindow:
    """Window of a viser server on one session.

    Args:
        server: viser's. run: folder that `save` writes into.
    """

    def __init__(self, server: Any, session: LabelSession, run: Path) -> None:
        self.server, self.session, self.run, self.lock = server, session, run, RLock()
        self.scene = ScanScene(server, session)
        self._places: list[np.ndarray] = []
        self._box: tuple[Any, Any] | None = None
        self._regions: list[UncertainRegion] = []
        self._at = -1
        self._build()
        self._listen_to_clicks()
        self._redraw()

    @property
    def address(self) -> str:
        """Return the address for a browser."""
        return address_of(self.server)

    def close(self) -> None:
        """Stop the server of the window."""
        stop_server(self.server)

    def say(self, words: str) -> None:
        """Show a line below the controls."""
        self._status.content = words

    # -- controls

    def _build(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.add_markdown(f"**{plain_markdown(self.run.resolve().name)}**")
        self._status = gui.add_markdown("")
        self._mode = gui.add_dropdown("Colours", MODES, initial_value=MODES[0] if self.session.has_labels else MODES[1])
        self._painted = gui.add_checkbox("Show corrected", True)
        views = gui.add_button_group("View", ("front", "left", "back", "right"))
        self._legend = gui.add_html("")
        with gui.add_folder("Correct"):
            tools = (BRUSH, PATCH, BOX, LANDMARK) if self.session.has_labels else (LANDMARK,)
            self._tool = gui.add_dropdown("Tool", tools)
            self._help = gui.add_markdown(_HELP[tools[0]])
            self._label = gui.add_dropdown("Label", self._known.names, initial_value=UPPER.name)
            self._radius = gui.add_slider("Brush (mm)", min=3, max=120, step=1, initial_value=20)
            self._size = gui.add_vector3("Box (m)", (0.2, 0.2, 0.2), min=(0.01,) * 3, max=(3.0,) * 3, step=0.01)
            self._fill = gui.add_button("Label what is in the box")
            self._mark = gui.add_dropdown("Landmark", CHOICE)
            self._unmark = gui.add_button("Remove landmark")
            undo = gui.add_button("Undo")
        with gui.add_folder("Corrections", expand_by_default=False):
            self._list = gui.add_dropdown("Entry", (_NONE,))
            remove = gui.add_button("Remove entry")
        with gui.add_folder("Uncertain regions"):
            self._doubt = gui.add_markdown("")
            steps = gui.add_button_group("Go to", ("previous", "next"))
        save = gui.add_button("Save", color="green")
        again = gui.add_button("Save and label again", visible=self.session.has_labels)
        self._mode.on_update(lambda _: self._redraw())
        self._painted.on_update(lambda _: self._repaint())
        self._tool.on_update(lambda _: self._choose_tool())
        self._size.on_update(lambda _: self._resize_box())
        self._label.on_update(lambda _: self._resize_box())
        self._mark.on_update(lambda _: self._remark())
        self._fill.on_click(lambda _: self._fill_box())
        self._unmark.on_click(lambda _: self._remove_landmark())
        undo.on_click(lambda _: self._undo())
        remove.on_click(lambda _: self._remove())
        save.on_click(lambda _: self._save())
        again.on_click(lambda _: self._label_again())
        views.on_click(lambda event: self._view(event.target.value))
        steps.on_click(lambda event: self._step(1 if event.target.value == "next" else -1))
        self._choose_tool()

    @one_at_a_time
    def _choose_tool(self) -> None:
        tool = self._tool.value
        self._help.content = _HELP[tool]
        self._label.visible = tool != LANDMARK
        self._radius.visible = tool == BRUSH
        self._size.visible = self._fill.visible = tool == BOX
        self._mark.visible = self._unmark.visible = tool == LANDMARK
        if tool == BOX and self._box is None:
            self._draw_box(self.scene.center)
        elif tool != BOX and self._box is not None:
            self._box[0].remove()
            self._box = None
        self._remark()

    # -- the pointer

    @one_at_a_time
    def click(self, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]) -> None:
        """Do what the tool does where a ray meets the scan."""
        surface, hit = self.session.surface, first_hit(self.session.surface, origin, direction)
        if hit is None:
            self.say("nothing of the scan is there")
            return
        match self._tool.value:
            case "brush":
                self._count(self.session.brush(self._label_id, [(hit.point[None], hit.normal[None])], self._meters))
            case "patch":
                self._count(self.session.patch(self._label_id, hit.face))
            case "box":
                self._draw_box(hit.point)
            case "landmark":
                name = self._mark.value
                within = middle_of_limb(surface, origin, direction) if lies_within(name) else None
                self.session.place(name, hit.point if within is None else within)
                self._changed(f"{name} placed" + (", within the limb" if within is not None else ", on the surface"))

    @one_at_a_time
    def drag(self, phase: str, origin: Float[np.ndarray, " 3"], place: Float[np.ndarray, " 3"]) -> None:
        """Paint along the places that a pointer goes through; what is under it shows at once, and counts at the end."""
        if self._tool.value != BRUSH:
            return
        self._places = [place] if phase == "start" or not self._places else [*self._places, place]
        surface = self.session.surface
        if phase != "end":
            for points, normals in line_under(surface, origin, np.stack(self._places[-2:]), self._meters):
                faces = stroked_faces(surface, points, self._meters, normals=normals)
                self.scene.draw_live(self.session, faces, self._label_id)
            return
        lines = line_under(surface, origin, np.stack(self._places), self._meters)
        self._places = []
        self._count(self.session.brush(self._label_id, lines, self._meters))
        self.scene.clear_live()

    def _listen(self, node: Any) -> None:
        """Hear drags on the scan. A coroutine, so that the events of a drag keep their order."""

        @node.on_drag("left", modifier="shift")
        async def _(event: Any) -> None:
            self.drag(event.phase, np.array(event.client.camera.position), np.array(event.end_position))

    def _listen_to_clicks(self) -> None:
        """Hear clicks, anywhere: a scan that hears them itself would get an outline under every pointer."""

        @self.server.scene.on_click(modifier="shift")
        async def _(event: Any) -> None:
            self.click(np.array(event.ray_origin), np.array(event.ray_direction))

    # -- what the controls do

    @property
    def _known(self) -> Labels:
        return self.session.scan.known

    @property
    def _label_id(self) -> int:
        return self._known.named(self._label.value).id

    @property
    def _meters(self) -> float:
        return 1e-3 * float(self._radius.value)

    def _draw_box(self, center: Float[np.ndarray, " 3"]) -> None:
        if self._box is not None:
            self._box[0].remove()
        self._box = self.scene.draw_box(center, np.array(self._size.value), self._known[self._label_id].display_rgb)

    @one_at_a_time
    def _resize_box(self) -> None:
        if self._box is not None:
            gizmo, shape = self._box
            shape.dimensions, shape.color = tuple(self._size.value), self._known[self._label_id].display_rgb
            self._box = gizmo, shape

    @one_at_a_time
    def _fill_box(self) -> None:
        if self._box is not None:
            gizmo = self._box[0]
            turn = Rotation.from_quat(np.roll(gizmo.wxyz, -1)).as_matrix()  # its w comes last
            self._count(self.session.box(self._label_id, np.array(gizmo.position), np.array(self._size.value), turn))

    @one_at_a_time
    def _remark(self) -> None:
        chosen = self._mark.value if self._tool.value == LANDMARK else None
        gizmo = self.scene.draw_landmarks(self.session, chosen)
        if gizmo is not None:
            name = self._mark.value

            @gizmo.on_drag_end
            async def _(event: Any) -> None:
                self.move_landmark(name, np.array(event.target.position))

    @one_at_a_time
    def move_landmark(self, name: str, point: Float[np.ndarray, " 3"]) -> None:
        """Move a landmark that is placed."""
        self.session.place(name, point)
        self._changed(f"{name} moved")

    @one_at_a_time
    def _remove_landmark(self) -> None:
        if self._mark.value in self.session.landmarks:
            self.session.remove_landmark(self._mark.value)
            self._changed(f"{self._mark.value} removed")

    @one_at_a_time
    def _undo(self) -> None:
        action = self.session.undo()
        self._changed(f"undone: {action}" if action else "nothing to undo")

    @one_at_a_time
    def _remove(self) -> None:
        if self._list.value != _NONE:
            number = int(self._list.value.split(":")[0]) - 1
            self.session.remove(number)
            self._redraw()
            self._changed(f"correction {number + 1} removed")

    @one_at_a_time
    def _save(self) -> None:
        written = self.session.save(self.run)
        self._changed(f"saved: {', '.join(written)}" if written else "nothing to save")

    @one_at_a_time
    def _label_again(self) -> None:
        self.session.save(self.run)
        self.say("labelling again ...")
        self.session = label_again(self.run)
        self._redraw()
        self._changed("labelled again; `smplxpp build` takes it on from there")

    @one_at_a_time
    def _view(self, side: str) -> None:
        self.scene.look_at_whole({"front": 0.0, "left": 90.0, "back": 180.0, "right": 270.0}[side])

    @one_at_a_time
    def _step(self, by: int) -> None:
        if self._regions:
            self._at = (self._at + by) % len(self._regions) if self._at >= 0 else 0
            self.scene.look_at(self._regions[self._at])
            self._show_regions()

    # -- what is shown

    @one_at_a_time
    def _redraw(self) -> None:
        self._listen(self.scene.draw_scan(self.session, self._mode.value))
        self._changed("")

    @one_at_a_time
    def _repaint(self) -> None:
        self.scene.draw_painted(self.session, shown=self._painted.value and self._mode.value == "labels")

    def _count(self, faces: int) -> None:
        self._changed(f"{faces} faces: {self._label.value}" if faces else "nothing there")

    def _changed(self, words: str) -> None:
        """Show the session again after a change."""
        session = self.session
        self._repaint()
        self._remark()
        if session.has_labels:
            labels, mesh = session.labels(), session.scan.mesh
            self._legend.content = legend(labels, mesh.face_areas, session.scan.known)
            self._regions = uncertain_regions(session.surface, labels, session.confidence(), session.corrected())
        names = [f"{k + 1}: {session.scan.known[item.label].name}" for k, item in enumerate(session.corrections.items)]
        self._list.options = tuple(names[::-1]) or (_NONE,)
        self._at = min(self._at, len(self._regions) - 1)
        self._show_regions()
        unsaved = " (*not saved*)" if session.changed else ""
        placed = f"{len(session.landmarks)} landmarks"
        self.say(f"{words or 'ready'}  \n{len(session.corrections)} corrections, {placed}{unsaved}")

    def _show_regions(self) -> None:
        if not self.session.has_labels:
            self._doubt.content = "no labels yet: place landmarks, save, and give `smplxpp build` again"
        elif not self._regions:
            self._doubt.content = "none"
        else:
            one = self._regions[max(self._at, 0)]
            place = f"{max(self._at, 0) + 1} of {len(self._regions)}"
            self._doubt.content = (
                f"{place}: {self._known[one.label].name}, {1e4 * one.area:.0f} cm², confidence {one.confidence:.2f}"
            )
