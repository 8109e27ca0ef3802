"""The `smplxpp` command: finds the subcommand, parses its options with tyro, reports errors in words.

A command is imported only when it is asked for, so that `smplxpp metrics` starts without the trainer.
"""

from __future__ import annotations

import json
import logging
import sys
import warnings
from importlib import import_module
from pathlib import Path

from rich.console import Console
from rich.logging import RichHandler
from rich.table import Table
from rich.text import Text

from pipelines.commands.help import alike, checked_arguments, command_help
from pipelines.commands.terminal import OutputError, end_of_output, error_in_words, print_error, standard_streams
from pipelines.runs.folders import refuse_old_run
from smplxpp import __version__
from smplxpp.core.errors import InputError, MissingExtraError, ToldInputError
from smplxpp.core.files.json_file import jsonable

# command -> (module, dataclass, one line of help)
COMMANDS: dict[str, tuple[str, str, str]] = {
    "build": (
        "pipelines.commands.build",
        "Build",
        "a scan, a body fit and labels in; an SMPLX++ template and a report out",
    ),
    "demo": (
        "pipelines.commands.demo",
        "Demo",
        "the embedded person from scan and photographs to a student that talks, with a report: five minutes",
    ),
    "register": (
        "pipelines.commands.register",
        "Register",
        "the body fitted to all frames of a capture (keypoints, masks, label maps, scans), or to a scan",
    ),
    "reconstruct": (
        "pipelines.commands.reconstruct",
        "ReconstructCommand",
        "photographs, cameras and masks of a capture in; a closed, coloured surface of one frame or of all out",
    ),
    "label": (
        "pipelines.commands.view",
        "Label",
        "labels and landmarks of a run's scan, corrected by hand in the browser and kept",
    ),
    "view": (
        "pipelines.commands.view",
        "View",
        "a run in the browser: layers, weights, Gaussians, photographs, frames, and a running training",
    ),
    "inspect": ("pipelines.commands.inspect", "Inspect", "summarise a run: stages, times, numbers against their gates"),
    "check": (
        "pipelines.commands.check",
        "CheckMesh",
        "a verdict on any mesh or template: faults, penetration, stretch, weights, each in colour",
    ),
    "fit": (
        "pipelines.commands.fit",
        "Fit",
        "a built template and one frame's photographs in; textured Gaussians on it and their figures out",
    ),
    "train": (
        "pipelines.commands.train",
        "Train",
        "a capture and a built template in; a teacher and the compact student that runs anywhere out",
    ),
    "evaluate": (
        "pipelines.commands.evaluate",
        "Evaluate",
        "a run's models on held-out views and poses: image and surface figures, speed, size, tables, pictures",
    ),
    # Before `batch`, because the first name that fits is taken.
    "batch status": ("pipelines.commands.batch", "BatchStatus", "what has become of the subjects of a batch"),
    "batch stop": ("pipelines.commands.batch", "BatchStop", "end a batch; what stands stays, and the batch can go on"),
    "batch retry": ("pipelines.commands.batch", "BatchRetry", "run the subjects of a batch again that failed"),
    "batch frames": (
        "pipelines.commands.batch_frames",
        "BatchFrames",
        "one long take in chunks of frames: reconstructed, registered or measured, and joined",
    ),
    "batch": (
        "pipelines.commands.batch",
        "RunBatch",
        "many subjects: check, build, train, evaluate and export each, on this machine, Ray or Slurm",
    ),
    "ablate": (
        "pipelines.commands.ablate",
        "Ablate",
        "variants of the avatar trained on one capture, measured by one protocol, in one table",
    ),
    "animate": (
        "pipelines.commands.animate",
        "Animate",
        "show a template or a trained student moving: MP4, GIF, PNG frames or an animated GLB",
    ),
    "talk": (
        "pipelines.commands.talk",
        "Talk",
        "an avatar that speaks a text or a recording: a film with sound, a page, or the motion",
    ),
    "chat": (
        "pipelines.commands.chat",
        "Chat",
        "a page in which the avatar answers typed or spoken messages with voice, face and hands",
    ),
    "export": (
        "pipelines.commands.export",
        "Export",
        "a student or a template in files: for our players, for other programs (splats, rigs, scenes), for printers",
    ),
    "web": (
        "pipelines.commands.web",
        "Web",
        "a page that plays a trained student: a folder for any host, one file that opens from disk, a server",
    ),
    "metrics": ("pipelines.commands.metrics", "Metrics", "distances between two meshes or two folders of frames"),
    "synth": ("pipelines.commands.synth", "Synth", "make a synthetic capture of a clothed person with moving cloth"),
    "capture check": (
        "pipelines.commands.capture",
        "CaptureCheckCommand",
        "faults of a capture's files, masks, parameters and calibration, with remedies",
    ),
    "capture convert": (
        "pipelines.commands.capture",
        "CaptureConvertCommand",
        "any capture that can be opened, to our layout or ActorsHQ's",
    ),
    "capture turntable": (
        "pipelines.commands.synth",
        "CaptureTurntable",
        "photographs or a video of a person who turns before one camera, to a capture with camera and poses",
    ),
    "capture masks": (
        "pipelines.commands.detect",
        "CaptureMasks",
        "masks of a capture's images by a matting model, empty plates or MediaPipe",
    ),
    "capture degrade": (
        "pipelines.commands.capture",
        "CaptureDegradeCommand",
        "a capture with exact inputs to one with a tracker's: noisy parameters, keypoints, estimated labels",
    ),
    "keypoints convert": (
        "pipelines.commands.detect",
        "KeypointsConvert",
        "keypoints of OpenPose, EasyMocap, mmpose, COCO or MediaPipe to ours",
    ),
    "keypoints detect": (
        "pipelines.commands.detect",
        "KeypointsDetect",
        "keypoints of a capture's images by MediaPipe or your own ONNX model",
    ),
    "params convert": ("pipelines.commands.params", "ParamsConvert", "body parameters of any known layout to ours"),
    "params inspect": (
        "pipelines.commands.params",
        "ParamsInspect",
        "what a motion holds: skeleton, frames, rate, unit, axes, what is left out, likely mistakes",
    ),
}
HELP = ("-h", "--help")
# Options of earlier versions that named the folder of the run, which is the first argument of every command now.
OLD_RUN_OPTIONS = {
    "build": ("--out", "-o"),
    "register": ("--out", "-o"),
    "reconstruct": ("--out", "-o"),
    "train": ("--run", "--run-folder"),
    "ablate": ("--run",),
}
USER_ERROR, INTERRUPTED = 2, 130


def main(argv: list[str] | None = None) -> int:
    """Run one subcommand and return its exit status.

    Returns:
        The exit status: 0, 1 for failed gates, 2 for the user's errors and the system's, 130 after an interrupt, 141
        when the output is closed.
    """
    args = list(sys.argv[1:] if argv is None else argv)
    with standard_streams():
        console = Console(stderr=True)
        try:
            try:
                return _answer(args, console)
            finally:
                sys.stdout.flush()  # errors of the stream are reported here and not at the end of the interpreter
        except OutputError as error:
            return end_of_output(error, console)


def _answer(args: list[str], console: Console) -> int:
    """Find the command that is meant and run it; errors come out in words."""
    if not args or args[0] in (*HELP, "help"):
        _print_help()
        return 0
    if args[0] in ("-V", "--version"):
        sys.stdout.write(f"smplxpp {__version__}\n")
        return 0
    # A command has one word or two. With --help a group of commands alone prints its members.
    name = next((n for n in COMMANDS if args[: len(n.split())] == n.split()), None)
    if name is None:
        if args[-1] in HELP and any(n.split()[0] == args[0] for n in COMMANDS):
            _print_help(args[0])
            return 0
        groups = [n for n in COMMANDS if n.split()[0] == args[0]]
        # Of a group its second word is compared, because the first is right.
        asked, word = (" ".join(args[:2]), args[1]) if len(args) > 1 and groups else (args[0], args[0])
        meant = alike(word, [n.split()[-1] for n in groups] or COMMANDS)
        hint = f"; did you mean {meant}?" if meant else ""
        known = ", ".join(groups or COMMANDS)
        answer = Text(f"no command {asked!r}{hint}{' Known' if hint else '; known'}: {known}")
        console.print(Text("error: ", style="red") + answer)
        return USER_ERROR
    # Log lines and warnings go to standard error, so that standard output holds the answer alone.
    rest = args[len(name.split()) :]
    logging.basicConfig(
        level=logging.INFO, format="%(message)s", handlers=[RichHandler(console=console, show_path=False)]
    )
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return _run(name, rest)
    # A closed pipe is no error of the input: the caller gives it an exit status of its own.
    except OutputError:
        raise
    except ToldInputError:
        return USER_ERROR
    except (InputError, MissingExtraError, OSError) as error:
        print_error(error, console)
        if "--json" in rest:
            sys.stdout.write(json.dumps({"error": _error_fields(error)}, indent=1) + "\n")
        return USER_ERROR
    except MemoryError as error:
        # numpy's own words name the size and the shape that did not fit.
        words = (
            f"command {name}: expected memory for {str(error) or 'an array'}, received none. Give it a smaller input "
            "or a smaller --scale, --size, --max-views or --threads where it has them; all finished stages are kept"
        )
        console.print(Text("error: ", style="red") + Text(words))
        if "--json" in rest:
            sys.stdout.write(json.dumps({"error": {"type": "MemoryError", "message": words}}) + "\n")
        return USER_ERROR
    except KeyboardInterrupt:
        console.print("interrupted; every finished stage is kept")
        return INTERRUPTED


def _run(name: str, args: list[str]) -> int:
    """Parse the options of a command, run it, and print its answer as JSON if asked for.

    Raises:
        InputError: an option or a run folder of earlier versions, an unknown option, or an error of the command.
    """
    import tyro

    old = next((option for option in OLD_RUN_OPTIONS.get(name, ()) if option in args), None)
    if old is not None:
        raise InputError(
            f"option {old}",
            expected="the folder of the run as the first argument",
            received=f"{old}, which an earlier version took",
            remedy=f"write `smplxpp {name} RUN ...`",
        )

    module, cls, description = COMMANDS[name]
    options = getattr(import_module(module), cls)
    if any(arg in HELP for arg in args):
        sys.stdout.write(command_help(name, options, description))
        return 0
    command = tyro.cli(
        options,
        prog=f"smplxpp {name}",
        description=description,
        args=checked_arguments(name, options, args),
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    # Every folder of a run that a command opens or writes comes in as one of its paths.
    for option, value in vars(command).items():
        if isinstance(value, Path) and option != "capture":
            refuse_old_run(value)
    result = command.run()
    if getattr(command, "json", False) and result is not None:
        sys.stdout.write(json.dumps(jsonable(result), indent=1) + "\n")
    return int(result.get("exit_status", 0)) if isinstance(result, dict) else 0


def _error_fields(error: Exception) -> dict[str, str]:
    fields = {
        name: getattr(error, name) for name in ("subject", "expected", "received", "remedy") if hasattr(error, name)
    }
    return {"type": type(error).__name__, "message": error_in_words(error), **fields}


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Show a warning in words, as errors are, without the line of code that gave them."""
    logging.getLogger("smplxpp").warning("%s", message)


def _print_help(group: str = "") -> None:
    """Print all commands, or those that start with the word `group`."""
    table = Table(show_header=False, box=None, padding=(0, 2))
    for name, (_, _, line) in COMMANDS.items():
        if group and name.split()[0] != group:
            continue
        table.add_row(f"[bold]smplxpp {name}[/]", line)
    console = Console()
    console.print(f"smplxpp {__version__}: personalised clothed body templates from scans, measured at every step\n")
    console.print(table)
    console.print("\n`smplxpp COMMAND --help` lists a command's options; `--json` prints its answer for machines.")


if __name__ == "__main__":
    sys.exit(main())
