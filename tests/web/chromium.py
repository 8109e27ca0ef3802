"""Headless Chromium, driven over the pipe of its own protocol (CDP): nothing but the standard library."""

from __future__ import annotations

import fcntl
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image

# Chromium reads commands from descriptor 3 and writes to 4; this puts our pipes there.
_SHIM = (
    "import os, sys; os.dup2(int(sys.argv[1]), 3); os.dup2(int(sys.argv[2]), 4); os.execvp(sys.argv[3], sys.argv[3:])"
)
# WebGPU computes without Vulkan, but cannot show what it drew.
_SWIFTSHADER = (
    *("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-unsafe-swiftshader"),
    *("--enable-features=Vulkan", "--use-vulkan=swiftshader", "--use-angle=swiftshader"),
)
LIMIT = 900.0
_ABOVE = 10
LOOKS = Path(__file__).parent / "looks"
# What a person can find in the page: its name, and its place in CSS pixels.
_SQUARE, _SHADE, _LETTERS, _MOVED = 10, 24, 20, 24  # CSS pixels, of 255, squares, CSS pixels
_PLACES = """Object.fromEntries([...document.querySelectorAll("h1, button, input, select, [role]")].map(one => {
    const { x, y, width, height } = one.checkVisibility() ? one.getBoundingClientRect() : {};
    const name = one.ariaLabel || one.title || one.textContent.slice(0, 24) || one.className;
    return [`${one.localName} ${name}`, [x, y, width, height].map(Math.round)];
  }).filter(([, [, , width, height]]) => width && height))"""


def find_chromium() -> str | None:
    """Return the program, or None where there is none."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)


class Page:
    """One page of a headless Chromium of its own; what its console says is kept.

    Args:
        folder: for the browser's profile. size: of the window, pixels. flags: more of the program's own.
    """

    def __init__(self, folder: Path, size: tuple[int, int] = (960, 640), flags: Sequence[str] = ()) -> None:
        program = find_chromium()
        assert program is not None
        self.errors: list[str] = []
        self._next, self._buffer, self._replies = 0, b"", {}
        to_read, self._to = os.pipe()
        self._from, to_write = os.pipe()
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD, _ABOVE) for end in (to_read, to_write)]
        for end in (to_read, to_write):
            os.close(end)
        self._browser = subprocess.Popen(
            [
                *(sys.executable, "-c", _SHIM, *map(str, ends), program),
                *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--mute-audio"),
                *("--remote-debugging-pipe", f"--user-data-dir={folder}", f"--window-size={size[0]},{size[1]}"),
                *_SWIFTSHADER,
                *flags,
                "about:blank",
            ],
            pass_fds=ends,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for end in ends:
            os.close(end)
        self._session: str | None = None
        try:
            target = self.send("Target.createTarget", url="about:blank")["targetId"]
            self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            for domain in ("Runtime", "Page", "Log"):
                self.send(f"{domain}.enable")
            self.resize(*size)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the browser: it goes when its pipe does."""
        os.close(self._to)
        os.close(self._from)
        try:
            self._browser.wait(30)
        except subprocess.TimeoutExpired:
            self._browser.kill()
            self._browser.wait(LIMIT)

    def processes(self) -> list[int]:
        """Return the browser's processes: its own and those that it started."""
        parents = {}
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                parents[int(stat.parent.name)] = int(stat.read_text().rsplit(")", 1)[1].split()[1])
            except FileNotFoundError:  # it has ended meanwhile
                continue
        found = [self._browser.pid]
        for process in found:
            found += [child for child, parent in parents.items() if parent == process]
        return found

    def resize(self, width: int, height: int) -> None:
        """Give the page another size, CSS pixels."""
        self.send(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 640
        )

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """Ask for one thing and wait for the answer."""
        self._next += 1
        message: dict[str, Any] = {"id": self._next, "method": method, "params": params}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        answer = self._wait(self._next)
        assert "error" not in answer, f"{method}: {answer['error']}"
        return answer["result"]

    def go(self, address: str) -> None:
        """Open a page and wait until its player is there and has opened what it was given."""
        # A page that is opened again at its own address answers for the new one until that is there.
        self.evaluate("window.left = true")
        self.send("Page.navigate", url=address)
        self.until("!window.left", "the page is not left")
        self.evaluate(
            "new Promise(done => { const look = () => window.smplxppPlayer || document.querySelector('.failed')"
            " ? done() : setTimeout(look, 50); look(); }).then(() => window.smplxppPlayer?.ready)"
        )

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression, that of a promise when it is there."""
        result = self.send("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def click(self, selector: str) -> None:
        """Press the mouse on the middle of an element, as a person does: browsers play no sound before that."""
        find = (
            f"(({{left, top, width, height}}) => [left + width / 2, top + height / 2])"
            f"(document.querySelector({json.dumps(selector)}).getBoundingClientRect())"
        )
        x, y = self.evaluate(find)
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def until(self, condition: str, what: str = "") -> None:
        """Wait until an expression is true in the page."""
        end = time.monotonic() + LIMIT
        while not self.evaluate(f"!!({condition})"):
            assert time.monotonic() < end, what or condition
            time.sleep(0.05)

    def picture(self, view: dict[str, Any]) -> np.ndarray:
        """Return what the player draws of a view, (H, W, 3) bytes."""
        import base64

        text = self.evaluate(f"window.smplxppPlayer.picture({json.dumps(view)})")
        shape = (view["camera"]["height"], view["camera"]["width"], 4)
        return np.frombuffer(base64.b64decode(text), np.uint8).reshape(shape)[..., :3]

    def screenshot(self, path: Path) -> None:
        """Write what the window shows as a PNG."""
        import base64

        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"]))

    def looks_as_kept(self, name: str, folder: Path) -> None:
        """Fail where the window does not look as `looks/NAME.png` and `.json` have it; what is seen goes to a folder.

        Letters, and their edges, differ among browsers and among machines' fonts, so that the picture is kept in
        squares of ten pixels, each their mean, and a square may be as any of its neighbours is kept. Fonts move twenty
        of them at most; small things, which are no more, are held by their places.
        """
        self.evaluate("Promise.all(document.getAnimations().map(one => one.finished)).then(() => 0)")
        self.screenshot(folder / f"{name}_whole.png")
        image = np.asarray(Image.open(folder / f"{name}_whole.png").convert("RGB"), float)
        rows, columns = (side // _SQUARE for side in image.shape[:2])
        squares = image[: rows * _SQUARE, : columns * _SQUARE].reshape(rows, _SQUARE, columns, _SQUARE, 3)
        seen, places = np.round(squares.mean(axis=(1, 3))).astype(np.int16), self.evaluate(_PLACES)
        Image.fromarray(seen.astype(np.uint8)).save(folder / f"{name}.png")
        (folder / f"{name}.json").write_text(json.dumps(places, indent=1) + "\n")
        hint = f"if the change is meant, copy {folder}/{name}.png and .json to {LOOKS}"
        assert (LOOKS / f"{name}.json").exists(), hint
        kept = np.asarray(Image.open(LOOKS / f"{name}.png").convert("RGB"), np.int16)
        assert kept.shape == seen.shape, hint
        for one, other in ((seen, kept), (kept, seen)):
            near = sliding_window_view(np.pad(other, ((1, 1), (1, 1), (0, 0)), mode="edge"), (3, 3), axis=(0, 1))
            apart = np.maximum(near.min(axis=(-1, -2)) - one, one - near.max(axis=(-1, -2))).max(axis=-1)
            assert (apart > _SHADE).sum() <= _LETTERS, f"{(apart > _SHADE).sum()} squares: {hint}"
        expected = json.loads((LOOKS / f"{name}.json").read_text())
        assert places.keys() == expected.keys(), hint
        near_enough = {key: max(_MOVED, place[2] / 4) for key, place in expected.items()}  # fonts are of many widths
        moved = {key for key in places if np.abs(np.subtract(places[key], expected[key])).max() > near_enough[key]}
        assert not moved, f"{moved}: {hint}"

    def _wait(self, number: int) -> dict[str, Any]:
        end = time.monotonic() + LIMIT
        while number not in self._replies:
            left = end - time.monotonic()
            assert left > 0, f"no answer in {LIMIT:g} s"
            assert self._browser.poll() is None, "the browser ended"
            if not select.select([self._from], [], [], min(left, 1.0))[0]:
                continue
            *messages, self._buffer = (self._buffer + os.read(self._from, 1 << 20)).split(b"\0")
            for message in map(json.loads, messages):
                if "id" in message:
                    self._replies[message["id"]] = message
                else:
                    self._note(message)
        return self._replies.pop(number)

    def _note(self, event: dict[str, Any]) -> None:
        """Keep what went wrong: uncaught errors, and errors and warnings of the console."""
        method, params = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.errors.append(str(params["exceptionDetails"].get("exception", params["exceptionDetails"])))
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            self.errors.append(str([argument.get("value") for argument in params["args"]]))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"])
