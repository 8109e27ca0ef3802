"""Numbers that the page's TypeScript repeats: each is equal to its source in Python, or to the flags of the linker."""

from __future__ import annotations

import ast
import inspect
import math
import re
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from avatar.conversation.conversation import MOST_TYPED
from avatar.conversation.hearing import RATE
from avatar.speech import audio_features
from avatar.speech.coarticulation import ARTICULATORS, Timing
from avatar.speech.face import JAW_ANGLE, MAX_UNOBSERVED
from avatar.speech.lips import PHONES, VERSION
from pipelines.web.chat_server import REPLACED
from smplxpp.cloth import garment_file
from smplxpp.core.params import DEFAULT_FPS

WEB = Path(__file__).resolve().parents[2] / "web"


def constants(path: str) -> dict[str, float]:
    """Return the numeric constants of a TypeScript or JavaScript file by name: `const A = 1, B = 2 ** 3;`."""
    found: dict[str, float] = {}
    for line in re.findall(r"^(?:export )?const ([^;]+);", (WEB / path).read_text(encoding="utf-8"), re.MULTILINE):
        for name, value in re.findall(r"(\w+) = ([^,]+)", line):
            number = evaluated(value, found)
            if number is not None:
                found[name] = number
    return found


def evaluated(text: str, known: dict[str, float]) -> float | None:
    """Return the value of arithmetic on numbers and known names, or None for anything else."""
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except SyntaxError:
        return None
    allowed = (ast.Expression, ast.Constant, ast.BinOp, ast.UnaryOp, ast.Name, ast.operator, ast.unaryop, ast.Load)
    if not all(isinstance(node, allowed) for node in ast.walk(tree)):
        return None
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    if not names <= known.keys():
        return None
    value = eval(compile(tree, "constant", "eval"), {"__builtins__": {}}, dict(known))
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def local(function: Callable[..., object], name: str) -> float:
    """Return the number that a function of Python gives a name of its own."""
    for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(function)))):
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == [name]:
            number = evaluated(ast.unparse(node.value), {})
            assert number is not None, f"{name} of {function.__qualname__} is no number"
            return number
    raise AssertionError(f"{function.__qualname__} gives no number the name {name}")


TIMING = Timing()
REPEATED = {
    "src/bundle/motion.ts": {"USUAL_RATE": DEFAULT_FPS},
    "src/chat/connection.ts": {"REPLACED": REPLACED},
    "src/chat/conversation.ts": {"MOST_TYPED": MOST_TYPED},
    "src/chat/microphone.ts": {"RATE": RATE},
    "src/cloth/driver.ts": {"SAME": local(garment_file._garment, "same")},
    "src/lips/features.ts": {
        "RATE": audio_features.RATE,
        "HOP": audio_features.HOP,
        "WINDOW": audio_features.WINDOW,
        "BANDS": audio_features.BANDS,
    },
    "src/lips/network.ts": {"VERSION": VERSION, "PHONES": len(PHONES), "ARTICULATORS": len(ARTICULATORS)},
    "src/lips/steady.ts": {name: ARTICULATORS.index(name.lower()) for name in ("JAW", "PRESS")},
    "src/lips/face.ts": {
        **{name: ARTICULATORS.index(name.lower()) for name in ("JAW", "PRESS")},
        **{"JAW_ANGLE": JAW_ANGLE, "MOST": MAX_UNOBSERVED},
    },
    "src/lips/visemes.ts": {
        **{name.upper(): place for place, name in enumerate(ARTICULATORS)},
        **{name.upper(): getattr(TIMING, name) for name in ("before", "after", "lead", "closing", "rest")},
    },
}


@pytest.mark.parametrize("path", REPEATED)
def test_the_page_repeats_the_numbers_of_python(path):
    found = constants(path)
    for name, value in REPEATED[path].items():
        assert name in found, f"{path} has no constant {name}"
        assert math.isclose(found[name], value, rel_tol=1e-12), f"{path}: {name} is {found[name]}, Python has {value}"


def test_the_memory_of_the_page_is_that_of_the_linker():
    page, linker = constants("src/native/memory.ts"), constants("kernels.mjs")
    assert page["STACK"] == linker["STACK"]
    assert page["FIRST"] * linker["PAGE"] == linker["FIRST"] and page["MOST"] * linker["PAGE"] == linker["MOST"]


def test_constants_are_found_in_the_forms_that_the_page_uses():
    assert evaluated("1 << 18", {}) == 2**18 and evaluated("16 * PAGE", {"PAGE": 4.0}) == 64.0
    assert evaluated("fetch()", {}) is None and evaluated("OTHER", {}) is None
