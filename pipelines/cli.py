"""The `smplxpp` command: finds the subcommand, parses its options with tyro, reports errors in words.

A command is imported only when it is asked for, so that `smplxpp metrics` starts without the trainer.
"""

from __future__ import annotations

import json
import logging
import sys
from importlib import import_module
from importlib.metadata import version

from rich.console import Console
from rich.logging import RichHandler
from rich.table import Table
from rich.text import Text

from smplxpp.core.artifact import jsonable
from smplxpp.core.errors import InputError, MissingExtraError

# command -> (module, dataclass, one line of help)
COMMANDS: dict[str, tuple[str, str, str]] = {
    "build": (
        "pipelines.commands.build",
        "Build",
        "a scan, a body fit and labels in; an SMPLX++ template and a report out",
    ),
    "inspect": ("pipelines.commands.inspect", "Inspect", "summarise a run: stages, times, numbers against their gates"),
    "animate": (
        "pipelines.commands.animate",
        "Animate",
        "show a template moving: MP4, GIF, PNG frames or an animated GLB",
    ),
    "metrics": ("pipelines.commands.metrics", "Metrics", "distances between two meshes or two folders of frames"),
    "params convert": ("pipelines.commands.params", "ParamsConvert", "body parameters of any known layout to ours"),
}
USER_ERROR, INTERRUPTED = 2, 130


def main(argv: list[str] | None = None) -> int:
    """Run one subcommand; returns the exit status (0, 2 for the user's errors, 1 for failed gates)."""
    args = list(sys.argv[1:] if argv is None else argv)
    console = Console(stderr=True)
    if not args or args[0] in ("-h", "--help", "help"):
        _print_help()
        return 0
    if args[0] in ("-V", "--version"):
        sys.stdout.write(f"smplxpp {version('smplxpp')}\n")
        return 0
    name = next((n for n in COMMANDS if args[: len(n.split())] == n.split()), None)
    if name is None:
        groups = [n for n in COMMANDS if n.split()[0] == args[0]]
        known = ", ".join(groups or COMMANDS)
        console.print(Text("error: ", style="red") + Text(f"no command {' '.join(args[:2])!r}; known: {known}"))
        return USER_ERROR
    rest = args[len(name.split()) :]
    logging.basicConfig(
        level=logging.INFO, format="%(message)s", handlers=[RichHandler(console=console, show_path=False)]
    )
    try:
        return _run(name, rest)
    except (InputError, MissingExtraError) as error:
        if "--json" in rest:
            sys.stdout.write(json.dumps({"error": _error_fields(error)}, indent=1) + "\n")
        console.print(Text("error: ", style="red") + Text(str(error)), soft_wrap=True)
        return USER_ERROR
    except KeyboardInterrupt:
        console.print("interrupted; every finished stage is kept")
        return INTERRUPTED


def _run(name: str, args: list[str]) -> int:
    import tyro

    module, cls, description = COMMANDS[name]
    command = tyro.cli(
        getattr(import_module(module), cls), prog=f"smplxpp {name}", description=description, args=args,
    )  # fmt: skip
    result = command.run()
    if getattr(command, "json", False):
        sys.stdout.write(json.dumps(jsonable(result), indent=1) + "\n")
    return int(result.get("exit_status", 0)) if isinstance(result, dict) else 0


def _error_fields(error: Exception) -> dict[str, str]:
    fields = {
        name: getattr(error, name) for name in ("subject", "expected", "received", "remedy") if hasattr(error, name)
    }
    return {"type": type(error).__name__, "message": str(error), **fields}


def _print_help() -> None:
    table = Table(show_header=False, box=None, padding=(0, 2))
    for name, (_, _, line) in COMMANDS.items():
        table.add_row(f"[bold]smplxpp {name}[/]", line)
    console = Console()
    console.print(
        f"smplxpp {version('smplxpp')}: personalised clothed body templates from scans, measured at every step\n"
    )
    console.print(table)
    console.print("\n`smplxpp COMMAND --help` lists a command's options; `--json` prints its answer for machines.")


if __name__ == "__main__":
    sys.exit(main())
