"""Pages that play an avatar: a folder for any static host, or one file with everything in it."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from smplxpp.core.files import atomic_write_bytes, read_bytes, read_text
from smplxpp.core.files.tensor_bytes import pack_tensors, unpack_tensors
from smplxpp.core.light import Relighting

if TYPE_CHECKING:
    from avatar.speech import Face


def lips_of(face: Face, stance: tuple[dict[str, np.ndarray], dict[str, float]] | None = None) -> bytes:
    """Return tensors in the layout of safetensors: those of `avatar.speech.lips.WEIGHTS`, `face.NAME`, `body.NAME`.

    Of the face: `basis` (6, E) of the articulators, `neutral`, `lowest`, `highest` (E), `jaw` (3) at rest, `jaw_reach`
    (2), radians that an open vowel hangs it and at most; of the body `stance`, which `avatar.driving.stance_of` makes.
    """
    from avatar.speech.face import JAW_ANGLE
    from avatar.speech.lips import WEIGHTS

    tensors, about = unpack_tensors(read_bytes(WEIGHTS, subject="lip network"), subject="lip network")
    own = {name: getattr(face, name) for name in ("basis", "neutral", "lowest", "highest", "jaw")}
    own["jaw_reach"] = np.array([JAW_ANGLE, face.jaw_reach])
    tensors |= {f"face.{name}": value for name, value in own.items()}
    if stance:
        tensors |= {f"body.{name}": value for name, value in stance[0].items()}
        about = {**about, "gestures": stance[1]}
    return pack_tensors(tensors, about)


PLAYER = Path(__file__).parent / "assets" / "player.js"
"""Built of `web/` by `npm run build`; a test holds it against its sources."""
INDEX, SCRIPT, AVATAR, SOUND, LIPS = "index.html", "player.js", "me.avatar", "sound.wav", "lips.safetensors"
# The page needs its script, a worker made of it and the WebAssembly in that, styles made by it, and avatars; it loads
# nothing else from anywhere.
_POLICY = (
    "default-src 'none'; script-src {script} 'wasm-unsafe-eval'; worker-src blob:; style-src 'unsafe-inline'; "
    "img-src data:; {connect}"
)
# Browsers give a page from disk no module that lies beside it: then only this script of the page itself can say so.
_FROM_DISK = """
if (location.protocol === "file:") {
  const notice = document.createElement("p");
  notice.className = "failed";
  notice.style.cssText = "margin: 20vh auto; max-width: 30em; padding: 1.5em; font: 16px/1.5 system-ui, sans-serif";
  notice.textContent = "This page was opened from disk, where a browser does not let it read the files beside it. " +
    "Serve its folder (smplxpp web --serve, or python -m http.server), " +
    "or make one file with smplxpp web --single-file.";
  document.body.append(notice);
}
"""
_FROM_DISK_DIGEST = base64.b64encode(hashlib.sha256(_FROM_DISK.encode()).digest()).decode()
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1, viewport-fit=cover">
<meta name="color-scheme" content="dark">
<meta name="theme-color" content="#121418">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<link rel="icon" href="data:,">
<title>{title}</title>
</head>
<body data-player{attributes}>
{body}
</body>
</html>
"""


@dataclass(frozen=True)
class PageLight:
    """Another light that a page begins with.

    Attributes:
        name: name on the page.
        relighting: the light, not turned, in the place of the capture's.
        turn: rotation of the light about +Y in degrees, which the page can change.
    """

    name: str
    relighting: Relighting
    turn: float = 0.0

    @property
    def text(self) -> str:
        """What the page reads: the harmonics of both lights, by colour."""
        lights = {"light": self.relighting.light, "captured": self.relighting.captured}
        numbers = {key: light.coefficients.ravel().tolist() for key, light in lights.items()}
        return json.dumps({"name": self.name, "turn": self.turn, **numbers})


@dataclass(frozen=True, kw_only=True)
class PageContent:
    """Content of a page beside its avatar.

    Attributes:
        name: name of the avatar, for the page's title.
        sound: WAV file that belongs to the bundle's motion, or None.
        light: light of the avatar; None for the capture's.
        lips: weights of `lips_of` with which live sound moves the mouth, or None.
    """

    name: str
    sound: bytes | None = None
    light: PageLight | None = None
    lips: bytes | None = None

    @property
    def beside(self) -> dict[str, bytes]:
        """What the page's script takes beside the avatar, by kind."""
        given = {"sound": self.sound, "lips": self.lips}
        return {kind: data for kind, data in given.items() if data is not None}

    @property
    def lit(self) -> str:
        """The attribute of the page's light."""
        return "" if self.light is None else f' data-light="{html.escape(self.light.text)}"'


def page_files(bundle: bytes, content: PageContent) -> dict[str, bytes]:
    """Return the files of a folder that plays a bundle, by name."""
    names = {"sound": SOUND, "lips": LIPS}
    page = _PAGE.format(
        policy=_POLICY.format(script=f"'self' blob: 'sha256-{_FROM_DISK_DIGEST}'", connect="connect-src *"),
        title=html.escape(content.name),
        attributes=f' data-avatar="{AVATAR}"'
        + "".join(f' data-{kind}="{names[kind]}"' for kind in content.beside)
        + content.lit,
        body=f'<script>{_FROM_DISK}</script>\n<script type="module" src="{SCRIPT}"></script>',
    )
    files = {INDEX: page.encode(), SCRIPT: _script().encode(), AVATAR: bundle}
    return {**files, **{names[kind]: data for kind, data in content.beside.items()}}


def chat_files(bundle: bytes, *, name: str, secret: str, sockets: Sequence[str]) -> dict[str, bytes]:
    """Return the files of a page that talks with its server, by name.

    Args:
        name: of the avatar. secret: path of the server's websocket, plain letters. sockets: addresses that it may have.
    """
    page = _PAGE.format(
        policy=_POLICY.format(script="'self' blob:", connect=f"connect-src 'self' {' '.join(sockets)}"),
        title=html.escape(name),
        attributes=f' data-avatar="{AVATAR}" data-chat="{html.escape(secret)}"',
        body=f'<script type="module" src="{SCRIPT}"></script>',
    )
    return {INDEX: page.encode(), SCRIPT: _script().encode(), AVATAR: bundle}


def write_page_folder(folder: str | Path, bundle: bytes, content: PageContent) -> list[Path]:
    """Write `page_files` into a folder, each whole or not at all; other files in it stay.

    Returns:
        The files.
    """
    paths = []
    for file, data in page_files(bundle, content).items():
        paths.append(Path(folder) / file)
        atomic_write_bytes(paths[-1], data)
    return paths


def single_page(bundle: bytes, content: PageContent) -> bytes:
    """Return one page with everything in it, which opens from disk and asks no network for anything."""
    # Neither may end the element that it stands in.
    script = _script().replace("</script", "<\\/script").replace("<!--", "<\\!--")
    inlined = "".join(
        f'<script type="text/plain" id="{kind}-data">{base64.b64encode(data).decode()}</script>\n'
        for kind, data in {"avatar": bundle, **content.beside}.items()
    )
    page = _PAGE.format(
        policy=_POLICY.format(script="'unsafe-inline' blob:", connect="connect-src 'none'"),
        title=html.escape(content.name),
        attributes=content.lit,
        body=f'{inlined}<script type="module">{script}</script>',
    )
    return page.encode()


def _script() -> str:
    return read_text(PLAYER, subject="the built web player")
