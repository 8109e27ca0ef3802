"""An isolated page shares its poses among threads, with the same bits; others, and one that loses them, go on alone."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from pipelines.web.page import PageContent, page_files, single_page
from pipelines.web.server import PageServer
from smplxpp.core.params import BodyParams
from tests.cloth.test_driver import swaying
from tests.dolls.doll import place_camera
from tests.runtime.bundles import EXACT, KINDS, student, write
from tests.web.avatars import NAME, SWAY_FPS, asked, camera, write_dressed
from tests.web.chromium import Page, find_chromium
from tests.web.modules import NEEDS_BUILD, node

IN_BROWSER = pytest.mark.skipif(find_chromium() is None, reason="no Chromium here (apt-get install chromium)")
THREADS = 3
PATIENCE = 900
"""Seconds until a page that does nothing is given up."""
# Before a script of a worker: any machine has three cores here. A worker's own workers have scripts, too.
_BEFORE = """(() => {
  const Whole = Blob;
  globalThis.Blob = class extends Whole {
    constructor(parts, options) { super(options?.type === "text/javascript" ? [%s, ...parts] : parts, options); }
  };
})();"""
_CORES = f"""Object.defineProperty(navigator, "hardwareConcurrency", {{ value: {THREADS} }});"""
_LOST = {
    "cannot start": """self.Worker = class { constructor() { throw new Error("no more threads"); } };""",
    "end at once": """const Whole = self.Worker; self.Worker = class extends Whole {
      constructor() {
        super(URL.createObjectURL(new Blob(["onmessage = () => { throw new Error('no more threads'); }"])));
      }
    };""",
    # Without a stack a thread dies of the first slice that it takes of the field, and never gives it back.
    "die at work": """const Whole = self.Worker; self.Worker = class extends Whole {
      postMessage(task) { super.postMessage({ ...task, stack: 0 }); }
    };""",
}


@NEEDS_BUILD
@pytest.mark.parametrize("kind", [*KINDS, "rounded"])
def test_slices_change_no_bit(tmp_path, kind):
    """Whoever takes which slice: the kernels give the same bytes for any number of slices."""
    path = tmp_path / "a.avatar"
    write(path, student("whole" if kind == "rounded" else kind), None if kind == "rounded" else EXACT)
    script = """
    const avatar = await read(given), found = [];
    for (const slices of [1, 2, 3, 16, 61]) {
      const native = new m.Native(), deformer = new m.Deformer(avatar, undefined, native);
      native.slices = slices;
      deformer.pose(m.poseAt(avatar.motion, 0.25));
      const { count } = deformer.order([0, 0, 1, 5], 0.01, [], true);
      const records = deformer.recordsFor([0.5, 0.8, 2], count);
      found.push(Buffer.from(Float32Array.from(records).buffer).toString("base64"));
    }
    const result = { same: found.every(one => one === found[0]), bytes: found[0].length };"""
    found = node(script, given=str(path))
    assert found["bytes"] > 1000 and found["same"]


def opened(page: Page, server: PageServer, before: str) -> None:
    """Open the server's page, a script run before those of its worker."""
    script = page.send("Page.addScriptToEvaluateOnNewDocument", source=_BEFORE % json.dumps(_CORES + before))
    page.errors.clear()
    page.go(f"{server.address}?renderer=webgl2")
    page.send("Page.removeScriptToEvaluateOnNewDocument", **script)
    assert page.evaluate("crossOriginIsolated")
    page.evaluate("smplxppPlayer.player.playing = smplxppPlayer.player.simulating = false")


def threads(page: Page) -> dict[str, Any]:
    """What the page says of its threads after the last picture."""
    return json.loads(page.evaluate("JSON.stringify(smplxppPlayer.player.threads)"))


@pytest.fixture(scope="module")
def server(avatar) -> Iterator[PageServer]:
    with PageServer(page_files(avatar.read_bytes(), PageContent(name=NAME))) as it:
        threading.Thread(target=it.serve_forever, daemon=True).start()
        yield it
        it.shutdown()


@pytest.fixture(scope="module")
def alone(browser, avatar, tmp_path_factory) -> list[np.ndarray]:
    """Pictures of two frames by a page from disk, which has one thread."""
    file = tmp_path_factory.mktemp("page") / "player.html"
    file.write_bytes(single_page(avatar.read_bytes(), PageContent(name=NAME)))
    browser.go(f"{file.as_uri()}?renderer=webgl2")
    assert not browser.evaluate("crossOriginIsolated")
    browser.evaluate("smplxppPlayer.player.playing = false")
    pictures = [browser.picture(asked(camera(), frame)) for frame in (0, 4)]
    assert threads(browser) == {"count": 1, "helped": 0, "lost": None}
    return pictures


@IN_BROWSER
def test_an_isolated_page_shares_its_poses_among_threads(browser, server, alone):
    opened(browser, server, "")
    for frame, expected in zip((0, 4), alone, strict=True):
        np.testing.assert_array_equal(browser.picture(asked(camera(), frame)), expected)
    # Threads that were started late, on a busy machine, help as well.
    end = time.monotonic() + PATIENCE
    while threads(browser)["helped"] == 0:
        assert time.monotonic() < end, "no thread helps"
        np.testing.assert_array_equal(browser.picture(asked(camera(), 4)), alone[1])
    assert threads(browser) | {"helped": 0} == {"count": THREADS, "helped": 0, "lost": None}
    browser.evaluate("smplxppPlayer.player.playing = true")
    while f"({THREADS} threads)" not in browser.evaluate("document.querySelector('.rates').textContent"):
        assert time.monotonic() < end, "the page does not tell its threads"
        time.sleep(0.1)
    assert browser.errors == []


@IN_BROWSER
@pytest.mark.parametrize("kind", _LOST)
def test_without_its_threads_a_page_goes_on_alone_and_says_so(browser, server, alone, kind):
    opened(browser, server, _LOST[kind])
    end = time.monotonic() + PATIENCE
    while threads(browser)["lost"] is None:
        assert time.monotonic() < end, "nobody has missed the threads"
        for frame, expected in zip((0, 4), alone, strict=True):
            np.testing.assert_array_equal(browser.picture(asked(camera(), frame)), expected)
    assert threads(browser)["count"] == 1
    np.testing.assert_array_equal(browser.picture(asked(camera(), 4)), alone[1])
    browser.evaluate("smplxppPlayer.player.playing = true")
    while "1 thread, the others failed" not in browser.evaluate("document.querySelector('.rates').textContent"):
        assert time.monotonic() < end, "the page does not tell that it is alone"
        time.sleep(0.1)
    assert browser.evaluate("document.querySelector('.failed')") is None
    assert browser.errors == []


@IN_BROWSER
@pytest.mark.long
def test_simulated_clothes_take_no_harm(browser, tmp_path):
    """Their driver shares the kernels' memory; with threads they hang as without."""
    path = tmp_path / "dressed.avatar"
    write_dressed(path, BodyParams.concatenate([swaying(k / SWAY_FPS) for k in range(6)]))
    view, file = place_camera("view", 30.0, size=(192, 256), height=0.7, target=0.7), tmp_path / "player.html"
    file.write_bytes(single_page(path.read_bytes(), PageContent(name=NAME)))

    def pictures() -> list[np.ndarray]:
        browser.evaluate("smplxppPlayer.player.playing = smplxppPlayer.player.simulating = false")
        asked_for = [
            {**asked(view, 0), "time": k / SWAY_FPS, **({"seconds": 1 / SWAY_FPS} if k else {})} for k in range(4)
        ]
        return [browser.picture(one) for one in asked_for]

    browser.go(f"{file.as_uri()}?renderer=webgl2")
    expected = pictures()
    assert np.abs(expected[3].astype(int) - expected[0]).max() > 20
    with PageServer(page_files(path.read_bytes(), PageContent(name=NAME))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        opened(browser, server, "")
        # What a page shows before it is told to halt differs, and the cloth begins there: bits are not the same.
        for got, one in zip(pictures(), expected, strict=True):
            assert np.abs(got.astype(int) - one).max() <= 8
        assert threads(browser)["count"] == THREADS
        server.shutdown()
