"""The avatar in another light: the page's numbers and pictures are those of Python."""

from __future__ import annotations

import base64
import threading
from pathlib import Path

import numpy as np
import pytest

from avatar.runtime import AvatarPlayer
from avatar.runtime.splatting import facing_normals
from pipelines.cli import main
from pipelines.commands.options import read_light
from pipelines.web.page import PageContent, PageLight, page_files
from pipelines.web.server import PageServer
from smplxpp.core.light import Irradiance, Relighting, panorama_directions
from tests.core.files.radiance import write_radiance
from tests.dolls.dancing import dance
from tests.runtime.bundles import student, write
from tests.web.avatars import BACKGROUND, NAME, asked, camera, decibels, motion
from tests.web.chromium import find_chromium
from tests.web.modules import NEEDS_BUILD, node

NEEDS_BROWSER = pytest.mark.skipif(find_chromium() is None, reason="no Chromium here (apt-get install chromium)")


@pytest.fixture(scope="module")
def panorama(tmp_path_factory) -> Path:
    """A red lamp from one side, a dim blue sky."""
    towards = panorama_directions(24, 48)
    lamp = np.exp(6.0 * (towards @ [0.8, 0.3, 0.52] - 1.0))[..., None] * [9.0, 4.0, 1.0]
    path = tmp_path_factory.mktemp("light") / "evening.hdr"
    write_radiance(path, lamp + np.maximum(towards[..., 1:2], 0.0) * [0.05, 0.1, 0.3], packed=True)
    return path


@NEEDS_BUILD
def test_the_page_takes_the_same_light_from_a_panorama(panorama, tmp_path):
    flat = tmp_path / "flat.hdr"
    write_radiance(flat, np.random.default_rng(1).uniform(0.0, 5.0, (5, 7, 3)), packed=False)
    normals = np.random.default_rng(0).normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    script = """
    const result = given.paths.map(path => {
      const light = m.harmonicsOf(m.readRadiance(new Uint8Array(readFileSync(path))));
      const M = m.matrices({ name: "", light, captured: m.WHITE }, 0.7);
      const at = given.normals.map(n => [0, 1, 2, 3, 4, 5].map(k => {
        const full = [...n, 1];
        let sum = 0;
        for (let i = 0; i < 16; ++i) sum += M[16 * k + i] * full[i >> 2] * full[i & 3];
        return sum;
      }));
      return { light, at };
    });"""
    paths = [panorama, flat]
    found = node(script, given={"paths": [str(path) for path in paths], "normals": normals.tolist()})
    for path, got in zip(paths, found, strict=True):
        truth = read_light(path).exposed()
        np.testing.assert_allclose(np.reshape(got["light"], (9, 3)), truth.coefficients, atol=1e-6)
        turned = read_light(path, turn=np.degrees(0.7)).exposed().at(normals)
        np.testing.assert_allclose(np.maximum(np.array(got["at"])[:, :3], 0.0), turned, atol=1e-5)
        np.testing.assert_allclose(np.array(got["at"])[:, 3:], 1.0, atol=1e-6)


@NEEDS_BUILD
def test_what_is_no_panorama_is_refused(panorama):
    whole = panorama.read_bytes()
    dark = whole[: whole.rindex(b"\n") + 1] + bytes(4 * 24 * 48)
    broken = {
        "cut": (whole[: len(whole) // 2], "damaged"),
        "foreign": (b"\x76\x2f\x31\x01" + whole, "no Radiance"),
        "turned": (whole.replace(b"-Y 24", b"+Y 24"), "from the top"),
        "huge": (whole.replace(b"-Y 24 +X 48", b"-Y 99999 +X 99999"), "too large"),
        "dark": (dark, "no light"),
    }
    script = """
    const result = Object.fromEntries(Object.entries(given).map(([name, text]) => {
      try { return [name, String(m.harmonicsOf(m.readRadiance(Uint8Array.from(atob(text), c => c.charCodeAt(0)))))]; }
      catch (error) { return [name, error.message]; }
    }));"""
    said = node(script, given={name: base64.b64encode(data).decode() for name, (data, _) in broken.items()})
    for name, (_, word) in broken.items():
        assert word in said[name], name


@NEEDS_BUILD
def test_normals_are_those_of_the_runtime(tmp_path):
    path, eye = tmp_path / "doll.avatar", (0.4, 0.8, 2.0)
    write(path, student("whole"), None)
    script = """
    const avatar = await read(given.path), deformer = new m.Deformer(avatar);
    deformer.pose(m.poseAt(avatar.motion, 2 / avatar.motion.framesPerSecond));
    const { count } = deformer.order([0, 0, 1, 5], 0.01, [], false);
    const plain = [...deformer.recordsFor(given.eye, count)].filter((_, k) => k % 14 === 13);
    const result = { plain, lit: [...deformer.recordsFor(given.eye, count, true)].filter((_, k) => k % 14 === 13) };"""
    got = node(script, given={"path": str(path), "eye": eye})
    assert not any(got["plain"])
    code = np.array(got["lit"])
    u, v = (np.floor(code / 4096) - 2048) / 2047, (code % 4096 - 2048) / 2047
    z = 1.0 - np.abs(u) - np.abs(v)
    over = np.maximum(-z, 0.0)
    found = np.stack([u - np.copysign(over, u), v - np.copysign(over, v), z], axis=1)
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    player = AvatarPlayer(path, threads=1)
    splats = player.pose(dance().frame(2))
    truth = facing_normals(player.normals, splats, np.array(eye))
    assert (truth != player.normals).any()
    np.testing.assert_allclose(found, truth, atol=1.5e-3)


def relit(avatar: Path, frame: int, relighting: Relighting | None) -> tuple[np.ndarray, np.ndarray]:
    """What the runtime draws of a frame in a light."""
    player = AvatarPlayer(avatar, threads=1)
    player.pose(motion().frame(frame))
    image, alpha = player.draw(camera(), background=BACKGROUND, relighting=relighting)
    return np.clip(image, 0.0, 1.0), alpha


@NEEDS_BROWSER
@pytest.mark.parametrize("renderer", ["webgpu", "webgl2"])
def test_pictures_in_another_light_are_those_of_the_runtime(browser, avatar, panorama, renderer):
    """A page that comes with a light, one that is dropped on it, turned and switched off."""
    captured = Irradiance.of_environment(np.linspace(0.2, 1.0, 8)[:, None, None] * np.ones((8, 16, 3))).exposed()
    light = PageLight("evening <b>", Relighting(read_light(panorama).exposed(), captured), turn=30.0)
    files = page_files(avatar.read_bytes(), PageContent(name=NAME, light=light))
    with PageServer(files) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser.errors.clear()
        browser.go(f"{server.address}?renderer={renderer}")
        browser.evaluate("smplxppPlayer.player.playing = false")
        view = asked(camera(), 4)

        def check(relighting: Relighting | None) -> np.ndarray:
            image, alpha = relit(avatar, 4, relighting)
            got = browser.picture(view) / 255.0
            assert decibels(got, image, alpha > 0.5) > 38.0
            assert decibels(got, image, alpha <= 0.5) > 38.0
            return got

        given = check(Relighting(read_light(panorama, turn=30.0).exposed(), captured))
        browser.evaluate("smplxppPlayer.player.lightTurn = -2")
        turned = check(Relighting(read_light(panorama, turn=np.degrees(-2.0)).exposed(), captured))
        assert browser.evaluate("document.querySelector('.panel').textContent").count("evening <b>") == 1
        switch = "[...document.querySelectorAll('.switch')].find(it => it.textContent === 'evening <b>')"
        browser.evaluate(f"{switch}.firstElementChild.click()")
        off = check(None)
        data = base64.b64encode(panorama.read_bytes()).decode()
        drop = """new Promise(done => {
          const transfer = new DataTransfer(), bytes = Uint8Array.from(atob(DATA), c => c.charCodeAt(0));
          transfer.items.add(new File([bytes], "dropped.hdr"));
          window.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer }));
          const look = () => document.body.textContent.includes(WORD) ? done(0) : setTimeout(look, 20);
          look();
        })"""
        browser.evaluate(drop.replace("DATA", f"'{data}'").replace("WORD", "'dropped.hdr'"))
        dropped = check(Relighting(read_light(panorama).exposed(), Irradiance.uniform()))
        inside = relit(avatar, 4, None)[1] > 0.5
        pictures = [given, turned, off, dropped]
        assert all(decibels(a, b, inside) < 30.0 for k, a in enumerate(pictures) for b in pictures[:k])
        browser.evaluate(drop.replace("DATA", f"'{data[:400]}'").replace("WORD", "'This light cannot be shown'"))
        np.testing.assert_array_equal(browser.picture(view) / 255.0, dropped)
        assert browser.errors == []
        server.shutdown()


def test_the_command_writes_the_light_into_the_page(avatar, panorama, tmp_path, capsys):
    single = tmp_path / "one.html"
    options = ["--environment", str(panorama), "--environment-turn", "40"]
    assert main(["web", str(avatar), "--single-file", str(single), *options]) == 0
    assert "evening" in single.read_text().split("<script")[0]
    none = ["--environment", str(tmp_path / "none.hdr")]
    assert main(["web", str(avatar), "--single-file", str(tmp_path / "two.html"), *none]) == 2
    assert main(["web", str(avatar), "--single-file", str(tmp_path / "two.html"), "--environment-turn", "4"]) == 2
    assert "panorama" in capsys.readouterr().err and not (tmp_path / "two.html").exists()
