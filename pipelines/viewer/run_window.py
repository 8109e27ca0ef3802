"""The window on a run: controls, what they do, and a thread that plays and looks what a training has left."""

from __future__ import annotations

import logging
import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.viewer.run_scene import RunScene
from pipelines.viewer.run_session import COLORINGS, TURNED, RunSession
from pipelines.viewer.server import address_of, one_at_a_time, plain_markdown, start_server, stop_server
from smplxpp.core.files.image_file import open_image

log = logging.getLogger(__name__)
# Ranges of the controls: degrees of a joint, number of expressions with a slider, and bound of a numbered coefficient.
_DEGREES, _EXPRESSIONS, _STRONGEST = 120.0, 10, 3.0
_NONE = "none"


def open_run_window(session: RunSession, *, host: str = "127.0.0.1", port: int = 8080) -> RunWindow:
    """Start a server with the window of a session; `RunWindow.close` ends it.

    Raises:
        MissingExtraError: viser is not installed.
    """
    return RunWindow(start_server("smplxpp view", host=host, port=port), session)


class RunWindow:
    """Window of a viser server on one session.

    Args:
        server: the server.
        session: the session.
    """

    def __init__(self, server: Any, session: RunSession) -> None:
        self.server, self.session, self.lock = server, session, threading.RLock()
        self.scene = RunScene(server, session)
        self._ended, self._picture_at = threading.Event(), (Path(), 0.0)
        self._layers: dict[str, Any] = {}
        self._build()
        self._redraw()
        self._photograph()
        self._tell()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Return the address for a browser."""
        return address_of(self.server)

    def close(self) -> None:
        """End the thread and the server."""
        self._ended.set()
        self._thread.join()
        stop_server(self.server)

    def say(self, words: str) -> None:
        """Show a line below the controls."""
        self._status.content = words

    # -- controls

    def _build(self) -> None:
        gui, session = self.server.gui, self.session
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.add_markdown(f"**{plain_markdown(session.run.resolve().name)}**")
        self._status = gui.add_markdown("")
        # A slider needs a range, also where there is one frame; it is disabled then.
        last = len(session.motion.numbers) - 1
        self._frame = gui.add_slider("Frame", min=0, max=max(last, 1), step=1, initial_value=0, disabled=not last)
        self._play = gui.add_checkbox("Play", False, disabled=not last)
        # Without Gaussians the layers of the template are shown first, else the Gaussians.
        has_splats = session.player is not None
        with gui.add_folder("Show"):
            self._splats = gui.add_checkbox("Gaussians", has_splats, disabled=not has_splats)
            self._light = gui.add_checkbox("in the new light", True, visible=session.relighting is not None)
            self._cloth = gui.add_checkbox("loose clothes simulated", session.simulated, visible=session.dressed)
            for layer in session.layers:
                self._layers[layer.name] = gui.add_checkbox(layer.name, not has_splats)
            self._tracked = gui.add_checkbox("tracked surface", False, disabled=session.tracked is None)
            photographed = session.capture is not None and session.motion.photographed
            self._photographs = gui.add_checkbox("photographs", False, disabled=not photographed)
        with gui.add_folder("Colours of the layers"):
            self._coloring = gui.add_dropdown("Colours", COLORINGS)
            self._joint = gui.add_dropdown("Weights of", session.template.body.joint_names, visible=False)
        with gui.add_folder("Pose by hand", expand_by_default=False):
            self._turned = gui.add_dropdown("Joint", TURNED, initial_value="left_shoulder")
            self._axes = [gui.add_slider(axis, -_DEGREES, _DEGREES, 1.0, 0.0) for axis in ("x", "y", "z")]
            reset = gui.add_button("As the frame has it")
        with gui.add_folder("Expression", expand_by_default=False):
            self._faces = {
                name: gui.add_slider(name, -_STRONGEST, _STRONGEST, 0.1, 0.0)
                for name in session.expressions[:_EXPRESSIONS]
            }
        with gui.add_folder("Training"):
            self._training = gui.add_markdown("")
            self._preview = gui.add_image(np.zeros((8, 8, 3), np.uint8), visible=False)
        self._listen(reset)

    def _listen(self, reset: Any) -> None:
        """Connect the controls with their actions."""
        self._frame.on_update(lambda _: self._go())
        self._photographs.on_update(lambda _: self._photograph(step_back=True))
        self._play.on_update(lambda _: None if self._play.value else self._photograph())
        for box in (self._splats, self._tracked, self._joint, *self._layers.values()):
            box.on_update(lambda _: self._redraw())
        self._light.on_update(lambda _: self._relight())
        self._cloth.on_update(lambda _: self._simulate())
        self._coloring.on_update(lambda _: self._recolor())
        self._turned.on_update(lambda _: self._show_turned())
        for axis in self._axes:
            axis.on_update(lambda _: self._turn())
        for name, slider in self._faces.items():
            slider.on_update(partial(self._express, name))
        reset.on_click(lambda _: self._reset())

    # -- what the controls do

    @one_at_a_time
    def _go(self) -> None:
        if int(self._frame.value) != self.session.at:
            self.session.go_to(int(self._frame.value))
            self._redraw()
            if not self._play.value:
                self._photograph()

    @one_at_a_time
    def _relight(self) -> None:
        self.session.relit = bool(self._light.value)
        self._redraw()

    @one_at_a_time
    def _simulate(self) -> None:
        self.session.simulated = bool(self._cloth.value)
        self._redraw()

    @one_at_a_time
    def _recolor(self) -> None:
        self._joint.visible = self._coloring.value == "one joint"
        self._redraw()

    @one_at_a_time
    def _show_turned(self) -> None:
        of_joint = self.session.turned.get(self._turned.value, (0.0, 0.0, 0.0))
        for axis, degrees in zip(self._axes, of_joint, strict=True):
            # Setting a slider calls its handler: only real changes are set, so that no redraw follows.
            if axis.value != degrees:
                axis.value = degrees

    @one_at_a_time
    def _turn(self) -> None:
        x, y, z = (float(axis.value) for axis in self._axes)
        if (x, y, z) != self.session.turned.get(self._turned.value, (0.0, 0.0, 0.0)):
            self.session.turn(self._turned.value, (x, y, z))
            self._redraw()

    @one_at_a_time
    def _express(self, name: str, *_: Any) -> None:
        if float(self._faces[name].value) != self.session.expression.get(name, 0.0):
            self.session.expression[name] = float(self._faces[name].value)
            self._redraw()

    @one_at_a_time
    def _reset(self) -> None:
        self.session.reset()
        for slider in (*self._axes, *self._faces.values()):
            slider.value = 0.0
        self._redraw()

    @one_at_a_time
    def _photograph(self, *, step_back: bool = False) -> None:
        self.scene.draw_photographs(self.session, shown=bool(self._photographs.value))
        if step_back:
            self.scene.step_back()

    # -- what is shown

    @one_at_a_time
    def _redraw(self) -> None:
        session, shown = self.session, {name for name, box in self._layers.items() if box.value}
        with self.server.atomic():
            self.scene.draw_layers(session, shown, self._coloring.value, self._joint.value)
            self.scene.draw_splats(session, shown=bool(self._splats.value))
            self.scene.draw_tracked(session, shown=bool(self._tracked.value))
        self.say(self._words())

    def _words(self) -> str:
        session = self.session
        of = "no Gaussians yet" if session.source is None else f"Gaussians: {plain_markdown(session.source.words)}"
        changed = ", changed by hand" if session.turned or session.expression else ""
        count = len(session.motion.numbers)
        source = plain_markdown(str(session.motion.source))
        return f"frame {session.frame} of {source} ({count}){changed}  \n{of}"

    @one_at_a_time
    def look_again(self) -> None:
        """Show what a training has left since the last look: its step, its newest picture, its Gaussians."""
        if self.session.refresh():
            if self._splats.disabled:
                self._splats.disabled, self._splats.value = False, True
            self._cloth.visible = self.session.dressed
            self._redraw()
        self._tell()

    def _tell(self) -> None:
        now = self.session.now
        self._training.content = "none is running" if now is None else plain_markdown(str(now))
        if now is None or now.picture is None:
            self._preview.visible = False
            return
        at = now.picture, now.picture.stat().st_mtime
        if at != self._picture_at:
            picture = open_image(now.picture, subject="picture").convert("RGB")
            self._preview.image, self._preview.label = np.asarray(picture), now.picture.stem
            self._preview.visible, self._picture_at = True, at

    def _live(self) -> None:
        """Play, and look again every few seconds, until the window is closed."""
        look_every = 3.0  # seconds between two checks for new files of a training
        waited = 0.0
        while True:
            pause = 1.0 / self.session.motion.fps if self._play.value else 0.2
            if self._ended.wait(pause):
                return
            waited += pause
            if self._play.value:
                self._frame.value = (int(self._frame.value) + 1) % len(self.session.motion.numbers)
                self._go()
            if waited >= look_every:
                waited = 0.0
                self.look_again()
