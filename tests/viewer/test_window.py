"""The window without a browser: a server that answers and ends, and what its controls and pointers do."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import urllib.error
import urllib.request

import numpy as np
import pytest
from viser import GuiApi

from pipelines.cli import main
from pipelines.commands import view as label_command
from pipelines.stages.build import build
from pipelines.stages.build_config import BuildConfig, BuildInputs, RegisterInputs, save_build
from pipelines.viewer.run_scene import label_again, open_session
from pipelines.viewer.server import one_at_a_time, plain_markdown
from pipelines.viewer.session import LabelledScan, LabelSession
from pipelines.viewer.window import LabelWindow, open_window
from smplxpp.core import HAIR, LOWER, SHOE, UPPER, InputError, concatenate_meshes
from smplxpp.segment import Corrections
from tests.pipelines.registrations import FIXTURE, use_keypoints, use_solver
from tests.pipelines.test_build import Small, small, small_scan  # noqa: F401
from tests.segment.test_corrections import tube

EYE = np.array([0.2, 0.5, 3.0])


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@pytest.fixture(scope="module")
def scan() -> LabelledScan:
    mesh = concatenate_meshes([tube(-0.2, rings=60, sides=24), tube(0.2, rings=60, sides=24)])
    labels = np.where(mesh.face_centers[:, 1] > 0.2, LOWER.id, SHOE.id)
    confidence = np.where(mesh.face_centers[:, 1] > 0.8, 0.4, 1.0)
    return LabelledScan(mesh, np.full((mesh.vertex_count, 3), 90, dtype=np.uint8), labels, confidence)


@pytest.fixture
def window(scan, tmp_path):
    one = open_window(LabelSession(scan), tmp_path, port=free_port())
    yield one
    one.close()


def said(window: LabelWindow) -> str:
    return window._status.content


def test_it_answers_on_this_machine_alone_and_ends(scan, tmp_path):
    port = free_port()
    before = threading.active_count()
    window = open_window(LabelSession(scan), tmp_path, port=port)
    assert window.server.get_host() == "127.0.0.1" and window.address.startswith(f"http://localhost:{port}/?token=")
    assert len(window.address.partition("=")[2]) >= 32
    # The token goes from the address into a cookie, without which nothing is shown to other users of the machine.
    browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with browser.open(window.address, timeout=60) as answer:
        assert answer.status == 200 and b"<html" in answer.read(4000).lower()
        assert answer.url == f"http://localhost:{port}/"
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(f"http://127.0.0.1:{port}/?token=guess", timeout=60)
    window.close()
    assert threading.active_count() <= before + 1
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind(("127.0.0.1", port))  # it is free again


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("127.0.0.1:{}", "http://evil.example", 403),
        ("evil.example:{}", None, 403),
        ("evil.example:{}", "http://evil.example:{}", 403),
        ("localhost:{}", "http://localhost:{}", 200),
        ("127.0.0.1:{}", None, 200),
    ],
)
def test_no_page_of_another_site_may_look(window, host, origin, status):
    port = window.server.get_port()
    access = window.server.access
    headers = {"Host": host.format(port), "Cookie": f"{access.cookie}={access.token}"}
    headers |= {} if origin is None else {"Origin": origin.format(port)}
    for upgrade in ({}, {"Upgrade": "websocket", "Connection": "Upgrade"}):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=900)
        connection.request("GET", "/", headers=headers | upgrade)
        # A handshake without its key is a bad request, of those who may ask.
        assert connection.getresponse().status in ((status,) if status == 403 else (200, 400, 426))
        connection.close()


def test_names_are_no_markup(scan, tmp_path, monkeypatch):
    text = plain_markdown("<img src=x onerror=alert(1)> [a](javascript:b) **c** `d` don't")
    assert "<" not in text and "](" not in text and "**" not in text.replace("\\*", "") and "don't" in text
    shown, show = [], GuiApi.add_markdown
    monkeypatch.setattr(
        GuiApi, "add_markdown", lambda gui, content, **more: (shown.append(content), show(gui, content))[1]
    )
    window = open_window(LabelSession(scan), tmp_path / "<img src=x onerror=alert(1)>", port=free_port())
    window._undo = lambda: (_ for _ in ()).throw(InputError("<b>", expected="<i>", received="<script>"))
    one_at_a_time(lambda window: window._undo())(window)
    assert "&lt;script&gt;" in said(window) and "onerror" in shown[0]
    assert not any("<" in one for one in (*shown, said(window)))
    window.close()


def test_a_click_does_what_the_tool_does(window, scan):
    ahead = np.array([0.2, 0.5, 0.06]) - EYE
    window.click(EYE, ahead)
    assert (window.session.labels() == UPPER.id).any() and "upper" in said(window) and "not saved" in said(window)
    window._label.value, window._tool.value = "hair", "patch"
    window.click(EYE, np.array([0.2, 0.1, 0.06]) - EYE)
    shoes = (scan.labels == SHOE.id) & (scan.mesh.face_centers[:, 0] > 0)
    assert (window.session.labels()[shoes] == HAIR.id).all()
    window._tool.value = "box"
    window.click(EYE, ahead)
    window._fill_box()
    assert len(window.session.corrections) == 3
    window._tool.value = "landmark"
    window._mark.value = "left_knee"
    window.click(EYE, ahead)
    np.testing.assert_allclose(window.session.landmarks["left_knee"], [0.2, 0.5, 0.0], atol=2e-3)
    assert "within the limb" in said(window)
    window._mark.value = "left_heel"
    window.click(EYE, ahead)
    assert window.session.landmarks["left_heel"][2] > 0.055
    window.move_landmark("left_heel", np.zeros(3))
    assert not window.session.landmarks["left_heel"].any()
    window.click(EYE, np.array([0.0, 1.0, 0.0]))
    assert "nothing of the scan" in said(window)


def test_a_drag_paints_at_its_end(window):
    places = [np.array([0.2, y, 0.5]) for y in np.linspace(0.4, 0.6, 5)]
    window.drag("start", EYE, places[0])
    for place in places[1:]:
        window.drag("update", EYE, place)
    assert len(window.session.corrections) == 0
    window.drag("end", EYE, places[-1])
    painted = window.session.scan.mesh.face_centers[window.session.corrected()]
    assert len(window.session.corrections) == 1 and np.ptp(painted[:, 1]) > 0.15
    window._undo()
    assert len(window.session.corrections) == 0 and "undone: upper painted" in said(window)


@pytest.mark.parametrize("mode", ["labels", "photograph", "confidence", "glass"])
def test_every_colour_is_drawn(window, mode):
    window.click(EYE, np.array([0.2, 0.5, 0.06]) - EYE)
    window._mode.value = mode
    window._redraw()
    assert "error" not in said(window)


def test_the_list_and_the_doubtful_regions_follow(window):
    assert "1 of 2" in window._doubt.content and "confidence 0.40" in window._doubt.content
    window._step(1)
    window._step(1)
    assert "2 of 2" in window._doubt.content
    window.click(EYE, np.array([0.2, 0.5, 0.06]) - EYE)
    assert window._list.options == ("1: upper",)
    window._remove()
    assert window._list.options == ("none",) and "removed" in said(window)


def test_saving_writes_the_files(window, tmp_path):
    window._save()
    assert "nothing to save" in said(window)
    window.click(EYE, np.array([0.2, 0.5, 0.06]) - EYE)
    window._save()
    assert "saved: labels_corrections.json" in said(window) and "not saved" not in said(window)
    assert len(Corrections.load(tmp_path / "labels_corrections.json")) == 1


# --- runs -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def run(small: Small):  # noqa: F811
    small.build("run", small.inputs(), last="20_segment")
    return small.folder / "run"


def test_labels_are_made_again_with_the_corrections(run):
    window = open_window(open_session(run), run, port=free_port())
    try:
        scan, before = window.session.scan, window.session.labels()
        top = scan.mesh.vertices[scan.mesh.vertices[:, 1].argmax()]
        window.session.box(UPPER.id, top, np.full(3, 0.1), np.eye(3))
        painted = window.session.corrected()
        window._label_again()
        assert "labelled again" in said(window) and not window.session.changed
        with np.load(run / "20_segment" / "labels.npz") as labels:
            np.testing.assert_array_equal(labels["corrected"], painted)
        # Taken back, the labels are those of before: the run keeps them.
        window.session.remove(0)
        np.testing.assert_array_equal(window.session.labels(), before)
    finally:
        window.close()


@pytest.mark.long
def test_a_build_that_stopped_has_a_scan_to_place_landmarks_on(small: Small, tmp_path):  # noqa: F811
    run, inputs = tmp_path / "begun", small.inputs(params=None)
    run.mkdir()
    save_build(run, inputs, BuildConfig())
    session = open_session(run)
    assert not session.has_labels and session.scan.mesh.face_count > 9000
    window = open_window(session, run, port=free_port())
    try:
        assert window._tool.options == ("landmark",) and "no labels yet" in window._doubt.content
    finally:
        window.close()


@pytest.mark.parametrize(("made", "words"), [(False, "no such folder"), (True, "a folder without one")])
def test_a_folder_without_a_scan_is_refused(tmp_path, capsys, made, words):
    run = tmp_path / "run"
    if made:
        run.mkdir()
    with pytest.raises(InputError, match=words):
        open_session(run)
    assert main(["label", str(run)]) == 2 and "smplxpp build" in " ".join(capsys.readouterr().err.split())


def test_the_command_serves_until_it_is_interrupted_and_keeps_what_was_not_saved(run, monkeypatch, capsys):
    opened, addresses = [], []

    def keep(*args, **choices):
        opened.append(open_window(*args, **choices))
        return opened[-1]

    def interrupted():
        opened[0].click(*look_at_the_middle(opened[0]))
        raise KeyboardInterrupt

    monkeypatch.setattr("pipelines.viewer.window.open_window", keep)
    monkeypatch.setattr(label_command, "wait", interrupted)
    monkeypatch.setattr("webbrowser.open_new_tab", addresses.append)
    port = free_port()
    assert main(["label", str(run), "--port", str(port)]) == 0
    printed = capsys.readouterr().out
    assert addresses[0].startswith(f"http://localhost:{port}/?token=") and "labels_corrections.json" in printed
    assert len(json.loads((run / "labels_corrections.json").read_text())["corrections"]) == 1


def look_at_the_middle(window: LabelWindow) -> tuple[np.ndarray, np.ndarray]:
    mesh = window.session.scan.mesh
    return mesh.vertices.mean(axis=0) + [0.0, 0.0, 3.0], np.array([0.0, 0.0, -1.0])


def test_a_run_that_does_not_say_what_it_was_built_from_is_not_labelled_again(run):
    (run / "build.json").unlink()
    window = open_window(open_session(run), run, port=free_port())
    try:
        window._label_again()
        assert "error" in said(window) and "build.json" in said(window)
    finally:
        window.close()


@pytest.mark.long
def test_labels_are_made_again_in_a_run_that_registers(small: Small, monkeypatch):  # noqa: F811
    """Its registration stands, and is not asked for again."""
    use_keypoints(monkeypatch)
    solver = use_solver(monkeypatch)
    run, inputs = small.folder / "registered", small.inputs(params=None, registers=True)
    registration = RegisterInputs(capture=FIXTURE, params=FIXTURE / "params" / "params_noisy.npz", frames=(0, 1))
    build(run, inputs, BuildConfig(), registration=registration, last="20_segment")
    session = open_session(run)
    session.box(HAIR.id, session.scan.mesh.vertices[0], np.full(3, 0.2), np.eye(3))
    session.save(run)
    again = label_again(run)
    assert len(solver.shown) == 1 and (again.labels() == session.labels()).all()
    (run / "register.json").unlink()
    with pytest.raises(InputError, match=r"register\.json"):
        label_again(run)


def test_build_and_viewer_meet_in_the_files(small: Small, run):  # noqa: F811
    session = open_session(run)
    session.box(HAIR.id, session.scan.mesh.vertices[0], np.full(3, 0.2), np.eye(3))
    session.save(run)
    inputs: BuildInputs = small.inputs()
    build(
        run,
        inputs,
        BuildConfig(budgets={"hair": 400, "shoe": 400, "upper": 1500, "lower": 1500, "outer": 400}),
        last="20_segment",
    )
    again = open_session(run)
    np.testing.assert_array_equal(again.labels(), session.labels())
    with np.load(run / "20_segment" / "labels.npz") as labels:
        np.testing.assert_array_equal(labels["face_labels"], session.labels())
