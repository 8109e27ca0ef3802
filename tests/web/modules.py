"""The player's own modules in Node: what the page computes, as numbers."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

WEB = Path(__file__).resolve().parents[2] / "web"
TOOLS = WEB / "node_modules" / ".bin"
NEEDS_BUILD = pytest.mark.skipif(
    shutil.which("node") is None
    or not all((WEB / "node_modules" / name).exists() for name in ("esbuild", "react", "three")),
    reason="no node with web/'s tools: npm ci in web/",
)


def node(script: str, *, given: object = None) -> Any:
    """Run a script that has the player's modules as `m` and JSON as `given`; return what `result` is."""
    subprocess.run(["node", "build.mjs", "--tests"], cwd=WEB, check=True, capture_output=True, timeout=900)
    whole = f"""import * as m from {json.dumps((WEB / "build" / "modules.mjs").as_uri())};
    import {{ readFileSync }} from "node:fs";
    const given = {json.dumps(given)};
    const read = path => m.readBundle(new Uint8Array(readFileSync(path)));
    {script}
    process.stdout.write(JSON.stringify(result));"""
    done = subprocess.run(
        ["node", "--input-type=module", "-e", whole], check=True, capture_output=True, text=True, timeout=900
    )
    return json.loads(done.stdout)
