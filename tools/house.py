"""Print the figures by which the structure and the language of the sources are followed over time.

Run `python -m tools.house` in a checkout; `python -m tools.house --list numbers` prints the places behind one figure.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("smplxpp", "avatar", "pipelines")
# Words that often stand where a noun or a term of the field belongs. They are counted, not forbidden.
MURKY = re.compile(
    r"\b(said|way|beyond|anew|nobody|doubts?|sure|by which|goes on|somebody|so many|(?:is|are) told)\b", re.IGNORECASE
)
SMALL_MODULE = 100
LONG_FUNCTION = 30
SHORT_DOCSTRING = 5


def modules() -> list[Path]:
    """Return the Python files of the three packages."""
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def is_number(node: ast.expr) -> bool:
    """Return whether an expression is a number, or arithmetic on numbers, or a tuple of them."""
    match node:
        case ast.Constant(value=value):
            return isinstance(value, int | float) and not isinstance(value, bool)
        case ast.UnaryOp(operand=operand):
            return is_number(operand)
        case ast.BinOp(left=left, right=right):
            return is_number(left) and is_number(right)
        case ast.Tuple(elts=elements) | ast.List(elts=elements):
            return bool(elements) and all(is_number(element) for element in elements)
    return False


def module_numbers(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and name of each number assigned at module level."""
    for node in tree.body:
        if isinstance(node, ast.Assign):
            targets, value = node.targets, node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            targets, value = [node.target], node.value
        else:
            continue
        for target in targets:
            if isinstance(target, ast.Name) and is_number(value):
                yield node.lineno, target.id
            elif isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and is_number(value):
                yield from ((node.lineno, ast.unparse(name)) for name in target.elts)


def import_lines(tree: ast.Module) -> int:
    """Return how many lines import statements take."""
    imports = (node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom))
    return sum((node.end_lineno or node.lineno) - node.lineno + 1 for node in imports)


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Yield every function and method of a module."""
    yield from (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the number of lines of a function, its docstring left out."""
    lines = (function.end_lineno or function.lineno) - function.lineno + 1
    if ast.get_docstring(function) is not None:
        docstring = function.body[0]
        lines -= (docstring.end_lineno or docstring.lineno) - docstring.lineno + 1
    return lines


def comment_lines(text: str) -> set[int]:
    """Return the numbers of the lines that bear a comment, alone or behind code."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {token.start[0] for token in tokens if token.type == tokenize.COMMENT}


def short_docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and text of docstrings whose first line has five words or fewer."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
            first = (ast.get_docstring(node) or "").split("\n")[0]
            if first and len(first.split()) <= SHORT_DOCSTRING:
                yield getattr(node, "lineno", 1), first


def count_lines(paths: list[Path]) -> int:
    """Return the number of lines in text files."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def measure() -> tuple[dict[str, float], dict[str, list[str]]]:
    """Return every figure, and for some of them the places that they count."""
    places: dict[str, list[str]] = {
        name: [] for name in ("small", "numbers", "uncommented", "short docstrings", "murky")
    }
    lines_of: dict[str, int] = dict.fromkeys(PACKAGES, 0)
    imports = comments = long_functions = 0
    for path in modules():
        text = path.read_text(encoding="utf-8")
        lines, tree, name = text.splitlines(), ast.parse(text), str(path.relative_to(ROOT))
        lines_of[name.split("/")[0]] += len(lines)
        imports += import_lines(tree)
        commented = comment_lines(text)
        comments += len(commented)
        if len(lines) < SMALL_MODULE:
            places["small"].append(f"{name}: {len(lines)}")
        places["numbers"] += [f"{name}:{line} {number}" for line, number in module_numbers(tree)]
        places["short docstrings"] += [f"{name}:{line} {first}" for line, first in short_docstrings(tree)]
        for function in functions(tree):
            if body_lines(function) >= LONG_FUNCTION:
                long_functions += 1
                if commented.isdisjoint(range(function.lineno, (function.end_lineno or 0) + 1)):
                    places["uncommented"].append(f"{name}:{function.lineno} {function.name}")
    texts = [*modules(), *(p for p in sorted((ROOT / "docs").glob("*.md")) if not p.name.startswith("benchmarks"))]
    for path in [*texts, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            places["murky"] += [f"{path.relative_to(ROOT)}:{number} {word.group()}" for word in MURKY.finditer(line)]
    total = sum(lines_of.values())
    figures = {
        "modules": len(modules()),
        "modules under 100 lines": len(places["small"]),
        "lines": total,
        "lines of pipelines": lines_of["pipelines"],
        "import lines, %": 100 * imports / total,
        "comment lines, %": 100 * comments / total,
        "numbers at module level": len(places["numbers"]),
        "functions of 30 lines or more": long_functions,
        "of those without a comment, %": 100 * len(places["uncommented"]) / max(long_functions, 1),
        "docstring first lines of five words or fewer": len(places["short docstrings"]),
        "murky words": len(places["murky"]),
        "README bytes": (ROOT / "README.md").stat().st_size,
        "lines of docs": count_lines(sorted((ROOT / "docs").glob("*.md"))),
        "lines of stored results": count_lines(sorted((ROOT / "benchmarks" / "results").rglob("*.json"))),
        "benchmark modules": len(list((ROOT / "benchmarks").rglob("*.py"))),
    }
    return figures, places


def main() -> int:
    """Entry point of `python -m tools.house`."""
    parser = argparse.ArgumentParser(prog="python -m tools.house", description=__doc__)
    parser.add_argument("--list", choices=("small", "numbers", "uncommented", "short docstrings", "murky"))
    options = parser.parse_args()
    figures, places = measure()
    if options.list:
        sys.stdout.write("\n".join(places[options.list]) + "\n")
    else:
        sys.stdout.write("".join(f"{value:10,.1f}  {name}\n" for name, value in figures.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
