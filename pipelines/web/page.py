"""Pages that play an avatar: a folder for any static host, or one file with everything in it."""

from __future__ import annotations

import base64
import html
from pathlib import Path

from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.paths import read_text

PLAYER = Path(__file__).parent / "assets" / "player.js"
"""Built of `web/` by `npm run build`; a test holds it against its sources."""
INDEX, SCRIPT, AVATAR = "index.html", "player.js", "me.avatar"
# The page needs its script, a worker made of it and the WebAssembly in that, styles made by it, and avatars; it loads
# nothing else from anywhere.
_POLICY = (
    "default-src 'none'; script-src {script} 'wasm-unsafe-eval'; worker-src blob:; style-src 'unsafe-inline'; "
    "img-src data:; {connect}"
)
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
<body{attributes}>
{body}
</body>
</html>
"""


def page_files(bundle: bytes, *, name: str) -> dict[str, bytes]:
    """Return the files of a folder that plays a bundle, by name.

    Args:
        name: of the avatar, for the page's title.
    """
    page = _PAGE.format(
        policy=_POLICY.format(script="'self' blob:", connect="connect-src *"),
        title=html.escape(name),
        attributes=f' data-avatar="{AVATAR}"',
        body=f'<script src="{SCRIPT}"></script>',
    )
    return {INDEX: page.encode(), SCRIPT: _script().encode(), AVATAR: bundle}


def write_page_folder(folder: str | Path, bundle: bytes, *, name: str) -> list[Path]:
    """Write `page_files` into a folder, each whole or not at all; other files in it stay.

    Returns:
        The files.
    """
    paths = []
    for file, content in page_files(bundle, name=name).items():
        paths.append(Path(folder) / file)
        atomic_write_bytes(paths[-1], content)
    return paths


def single_page(bundle: bytes, *, name: str) -> bytes:
    """Return one page with player and bundle in it, which opens from disk and asks no network for anything."""
    # Neither may end the element that it stands in.
    script = _script().replace("</script", "<\\/script").replace("<!--", "<\\!--")
    data = base64.b64encode(bundle).decode()
    page = _PAGE.format(
        policy=_POLICY.format(script="'unsafe-inline' blob:", connect="connect-src 'none'"),
        title=html.escape(name),
        attributes="",
        body=f'<script type="text/plain" id="avatar-data">{data}</script>\n<script>{script}</script>',
    )
    return page.encode()


def _script() -> str:
    return read_text(PLAYER, subject="the built web player")
