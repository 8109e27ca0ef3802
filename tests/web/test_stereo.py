"""The page in a headset, played by a stand-in for the browser's WebXR: no device was ever tried."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipelines.web.page import PageContent, single_page
from tests.web.avatars import NAME, asked, camera, decibels, write_avatar
from tests.web.chromium import Page, find_chromium

pytestmark = pytest.mark.skipif(find_chromium() is None, reason="no Chromium here (apt-get install chromium)")
SIDE, TANGENTS = 192, (0.55, 0.45, 0.5, 0.6)
"""Pixels a side of an eye; of its frustum's left, right, lower and upper edge for the left eye."""
EYES = {"left": -0.032, "right": 0.032}
HEAD = (0.1, 0.6, -0.4)
# A session whose eyes look along -z, a layer that is a framebuffer of its own, and frames that a timer gives.
HEADSET = """
(() => {
  const side = %(side)d, head = %(head)s, eyes = %(eyes)s, tangents = %(tangents)s, near = 0.05, far = 1000;
  const headset = window.headset = { asked: [], session: null, gl: null, layer: null };
  const place = dx => {
    const at = [head[0] + dx, head[1], head[2]], plain = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];
    return { matrix: Float32Array.from([...plain, ...at, 1]),
      inverse: { matrix: Float32Array.from([...plain, ...at.map(x => -x), 1]) } };
  };
  const projection = (l, r, b, t) => Float32Array.from([2 / (l + r), 0, 0, 0, 0, 2 / (b + t), 0, 0,
    (r - l) / (l + r), (t - b) / (b + t), -(far + near) / (far - near), -1, 0, 0, -2 * far * near / (far - near), 0]);
  const [l, r, b, t] = tangents;
  const views = Object.entries(eyes).map(([eye, dx]) => ({ eye, transform: place(dx),
    projectionMatrix: eye === "left" ? projection(l, r, b, t) : projection(r, l, b, t) }));
  class Session extends EventTarget {
    requestReferenceSpace(kind) {
      headset.asked.push(kind);
      const none = kind === "local-floor" && headset.noFloor;
      return none ? Promise.reject(new Error("no floor")) : Promise.resolve({ kind });
    }
    updateRenderState(state) { headset.layer = state.baseLayer; }
    requestAnimationFrame(callback) {
      const frame = { getViewerPose: () => ({ transform: place(0), views }) };
      setTimeout(() => this.ended || callback(performance.now(), frame), 30);
      return 1;
    }
    async end() { this.ended = true; this.dispatchEvent(new Event("end")); }
  }
  window.XRWebGLLayer = class {
    constructor(session, gl) {
      headset.gl = gl;
      this.framebuffer = gl.createFramebuffer();
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, 2 * side, side);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    }
    getViewport(view) { return { x: view.eye === "left" ? 0 : side, y: 0, width: side, height: side }; }
  };
  WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
  headset.pixels = () => {
    const { gl, layer } = headset, bytes = new Uint8Array(8 * side * side);
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    gl.readPixels(0, 0, 2 * side, side, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return btoa(Array.from(bytes, byte => String.fromCharCode(byte)).join(""));
  };
  Object.defineProperty(navigator, "xr", { value: {
    isSessionSupported: async mode => mode === "immersive-vr",
    requestSession: async (mode, options) => {
      if (headset.refuses) throw new Error("somebody else has it");
      headset.asked.push(mode, ...options.optionalFeatures);
      return headset.session = new Session();
    },
  } });
})();
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Iterator[Page]:
    folder: Path = tmp_path_factory.mktemp("stereo")
    file = folder / "player.html"
    file.write_bytes(single_page(write_avatar(folder / "doll.avatar"), PageContent(name=NAME)))
    words = {"side": SIDE, "head": json.dumps(HEAD), "eyes": json.dumps(EYES), "tangents": json.dumps(TANGENTS)}
    with Page(folder / "browser") as it:
        it.send("Page.addScriptToEvaluateOnNewDocument", source=HEADSET % words)
        it.go(file.as_uri())
        it.evaluate("smplxppPlayer.player.playing = false, smplxppPlayer.player.seek(0)")
        yield it
        assert it.errors == []


def wait(page: Page, condition: str) -> None:
    end = time.monotonic() + 300
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        time.sleep(0.1)


def test_both_eyes_see_what_cameras_there_see(page):
    wait(page, "!document.querySelector('.stereo').hidden")
    about = page.evaluate("smplxppPlayer.player.summary")
    page.evaluate("document.querySelector('.stereo').click()")
    wait(page, "smplxppPlayer.player.immersed")
    before = page.evaluate("smplxppPlayer.player.pictures")
    wait(page, f"smplxppPlayer.player.pictures > {before} + 2")
    assert page.evaluate("headset.asked") == ["immersive-vr", "local-floor", "local-floor"]
    raw = np.frombuffer(base64.b64decode(page.evaluate("headset.pixels()")), np.uint8)
    both = raw.reshape(SIDE, 2 * SIDE, 4)[::-1, :, :3]
    page.evaluate("headset.session.end()")
    wait(page, "!smplxppPlayer.player.immersed")
    # The avatar stands two metres before the origin, its feet on the floor.
    middle = np.array(about["middle"])
    shift = np.array([-middle[0], about["reach"] - middle[1], -2.0 - middle[2]])
    seen = {}
    for eye, (name, dx) in enumerate(EYES.items()):
        left, right, lower, upper = TANGENTS if name == "left" else (TANGENTS[1], TANGENTS[0], *TANGENTS[2:])
        place = np.array(HEAD) + [dx, 0.0, 0.0] - shift
        rows = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
        fx, fy = SIDE / (left + right), SIDE / (lower + upper)
        its = {
            "view": np.column_stack([rows, -rows @ place]).ravel().tolist(),
            **{"fx": fx, "fy": fy, "cx": left * fx, "cy": upper * fy, "width": SIDE, "height": SIDE},
        }
        whole = asked(camera(), 0) | {"camera": its, "background": [0.071, 0.078, 0.094]}
        seen[name] = page.picture(whole).astype(float)
        got = both[:, eye * SIDE : (eye + 1) * SIDE] / 255.0
        inside = np.abs(seen[name] - seen[name][0, 0]).max(axis=2) > 8
        assert 0.01 < inside.mean() < 0.9
        # The order and the colours are those of the middle of the head.
        assert np.square(got - seen[name] / 255.0)[inside].mean() < 0.025**2, name
        assert np.abs(got - seen[name] / 255.0)[~inside].max() < 0.04
    inside = np.abs(seen["left"] - seen["left"][0, 0]).max(axis=2) > 8
    assert decibels(both[:, SIDE:] / 255.0, seen["left"] / 255.0, inside) < 25.0


def test_the_page_goes_on_after_the_headset(page):
    before = page.evaluate("smplxppPlayer.player.update(), smplxppPlayer.player.pictures")
    wait(page, f"smplxppPlayer.player.pictures > {before}")


def test_without_a_floor_it_is_taken_to_be_below_the_eyes(page):
    page.evaluate("headset.noFloor = true, headset.asked.length = 0, document.querySelector('.stereo').click()")
    wait(page, "headset.asked.length === 4 && smplxppPlayer.player.immersed")
    assert page.evaluate("headset.asked")[2:] == ["local-floor", "local"]
    page.evaluate("headset.session.end(), headset.noFloor = false")
    wait(page, "!smplxppPlayer.player.immersed")


def test_a_headset_that_refuses_is_said(page):
    page.evaluate("headset.refuses = true, document.querySelector('.stereo').click()")
    wait(page, "!!document.querySelector('.card.failed')")
    assert "somebody else has it" in page.evaluate("document.querySelector('.card.failed').innerText")
    assert page.evaluate("smplxppPlayer.player.immersed") is False
