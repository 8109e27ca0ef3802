"""A command in the place of `smplxpp`: it answers as its options say, and makes the files by which its step stands.

`--name do` of a step chooses: `ok`, `crash` (an exception), `kill` (a signal, `--times` times), `refuse` (an error in
three sentences), `gates` (exit status 1 with a failed check), `full` (a full disk), `again` (unfinished, `--times`
times), `hang` (until it is ended). Every run to the end adds a line to `ends.txt` of the subject's folder.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

FILES = {
    "build": "08_capture/manifest.json",
    "train": "80_teacher/manifest.json",
    "evaluate": "95_evaluate/manifest.json",
}


def main(words):
    options = dict(zip([w[2:] for w in words if w.startswith("--")], [*words[1:], ""], strict=False))
    options = {words[i][2:]: words[i + 1] for i in range(len(words) - 1) if words[i].startswith("--")}
    step = words[1] if words[0] == "capture" else words[0]
    folder = Path(options["out"]).parent if words[0] in ("capture", "export") else Path(words[1]).parent
    do, times = options.get("do", "ok"), int(options.get("times", 1))
    counter = folder / f"{step}.tries"
    tries = len(counter.read_text()) if counter.exists() else 0
    with open(counter, "a") as file:
        file.write("x")
    sys.stderr.write(f"{step} {do} {tries}\n")
    time.sleep(float(options.get("seconds", 0)))
    if do == "crash":
        raise RuntimeError("a face without corners")
    if do == "kill" and tries < times:
        os.kill(os.getpid(), signal.SIGKILL)
    if do == "hang" and tries < times:
        time.sleep(600)
    if do == "refuse":
        error = {"type": "InputError", "subject": "scan", "expected": "a person", "received": "half of one"}
        sys.stdout.write(json.dumps({"error": {**error, "remedy": "scan again", "message": "scan: expected a person"}}))
        return 2
    if do == "full":
        message = f"{folder}: {os.strerror(28)} (0.0 MB are free there)"
        sys.stdout.write(json.dumps({"error": {"type": "OSError", "message": message}}))
        return 2
    if do == "gates":
        sys.stdout.write(
            json.dumps({"checks": [{"name": "P2S", "status": "fail"}, {"name": "webs", "status": "pass"}]})
        )
        return 1
    made = {
        "convert": folder / "capture" / "capture.json",
        "check": folder / "check" / "check.json",
        "export": folder / f"{folder.name}.avatar",
    }.get(step, folder / "run" / FILES.get(step, ""))
    made.parent.mkdir(parents=True, exist_ok=True)
    stood = made.is_file()
    facts = {k: os.environ.get(k) for k in ("CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS")}
    if not stood:
        made.write_text(json.dumps({"step": step}))
        with open(folder / "ends.txt", "a") as file:
            file.write(f"{step}\n")
    sys.stdout.write(
        json.dumps({"finished": not (do == "again" and tries < times), "checks": [], **facts, "words": words})
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
