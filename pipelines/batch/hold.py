"""Hold a batch or a subject for one process at a time across machines, and ask those that work on a batch to stop.

Two means, because no file system of a cluster is certain to have the first:

| file system | lock of the system (`flock`) | heartbeat |
|---|---|---|
| local disk | yes, ends with the process | not needed |
| NFS 4, NFS 3 with lockd | yes, across machines; ends a lease (90 s) after its client | second guard |
| NFS with `nolock` or `local_lock=flock` | on one machine alone | guards across machines |
| Lustre with `-o flock` | yes, across machines | second guard |
| Lustre with `localflock`, or without either option | on one machine, or none | guards across machines |

The heartbeat is the file's own time of change, which its holder renews. Its age is measured against a file written to
the same folder at that moment, so that the clocks of the machines need not agree. A holder that is cut off for longer
than `STALE` may find its place taken: it sees another's mark in the file at its next beat, and gives up.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from pipelines.batch.records import now
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_text, try_lock
from smplxpp.core.files.json_file import as_object, parse_json
from smplxpp.core.files.paths import age_of, process_runs

BATCH_HOLD, JOB_HOLD, STOP_FILE = ".batch.lock", ".job.lock", "stop.json"


class Hold:
    """A file that one process holds, from `with` to its end.

    Args:
        path: of the file, whose folder exists.
        subject: what is held, in an error's words.
        remedy: what whoever comes second can do.
        beat: seconds between two renewals. Attributes that metadata caches keep are some seconds old.
        stale: seconds without renewal after which a holder on another machine counts as lost: longer than a lease of
            NFS, so that what a server gives back in time is not taken.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, Hold(Path(folder) / ".lock", subject="batch") as hold:
        ...     print(hold.lost)
        False
    """

    def __init__(self, path: Path, *, subject: str, remedy: str = "", beat: float = 10.0, stale: float = 120.0) -> None:
        self.path, self.subject, self.remedy = path, subject, remedy
        self.beat, self.stale = beat, stale
        self.lost = False
        self._mark = secrets.token_hex(8)
        self._ended = threading.Event()
        self._file: Any = None

    def __enter__(self) -> Hold:
        return self if self._file else self.take()

    def take(self) -> Hold:
        """Take the file, until the end of a `with`.

        Raises:
            InputError: another process holds it; the message names its machine, process and last sign of life.
        """
        self._file = open(self.path, "a+", encoding="utf-8")
        locked: bool | None = None
        with suppress(OSError):  # a file system without locks: the heartbeat decides
            locked = try_lock(self._file.fileno())
        holder = read_holder(self.path)
        if locked is False or (holder and self._lives(holder, locked=locked is not None)):
            self._file.close()
            self._file = None
            raise InputError(
                self.subject,
                expected="no other process at work on it",
                received=f"one on {holder.get('host', 'another machine')}, process {holder.get('pid', '?')}, since "
                f"{holder.get('since', '?')}",
                remedy=self.remedy,
            )
        content = {"host": socket.gethostname(), "pid": os.getpid(), "since": now(), "mark": self._mark}
        self._write(json.dumps(content))
        threading.Thread(target=self._renew, name=f"holds {self.path.name}", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        # An empty file tells a process on another machine at once that no process holds it.
        if not self.lost:
            with suppress(OSError):
                self._write("")
        self._file.close()

    def _lives(self, holder: dict[str, Any], *, locked: bool) -> bool:
        """Return whether the file's holder is still at work, where the system's lock did not say so."""
        if holder.get("host") == socket.gethostname():
            return not locked and process_runs(int(holder.get("pid") or 0))
        return age_of(self.path) < self.stale

    def _write(self, text: str) -> None:
        self._file.seek(0)
        self._file.truncate()
        self._file.write(text)
        self._file.flush()
        os.fsync(self._file.fileno())

    def _renew(self) -> None:
        """Renew the file until the end, or until it bears another's mark."""
        while not self._ended.wait(self.beat):
            with suppress(OSError):  # a server that does not answer: its next answer counts
                # A file that cannot be read for a moment bears no mark.
                if read_holder(self.path).get("mark", self._mark) != self._mark:
                    self.lost = True
                    return
                os.utime(self.path)


def read_holder(path: Path) -> dict[str, Any]:
    """Return host, pid, since and mark of who holds a file; empty where no process does, or none can be told."""
    try:
        text = path.read_text(encoding="utf-8")
        return as_object(parse_json(text, subject="lock"), subject="lock") if text else {}
    except (OSError, InputError):
        return {}


def at_work(path: Path, *, stale: float = 120.0) -> dict[str, Any]:
    """Return who holds a file now, as far as a reader can tell; empty where no process does."""
    holder = read_holder(path)
    if not holder:
        return {}
    own = holder.get("host") == socket.gethostname()
    return holder if (process_runs(int(holder.get("pid") or 0)) if own else age_of(path) < stale) else {}


def request_stop(runs: Path) -> None:
    """Ask all that work on a batch to end: they interrupt their commands, and begin no others."""
    atomic_write_text(runs / STOP_FILE, json.dumps({"requested": now(), "host": socket.gethostname()}) + "\n")


def stop_requested(runs: Path) -> bool:
    """Return whether a stop is asked for."""
    return (runs / STOP_FILE).exists()


def withdraw_stop(runs: Path) -> None:
    """Take a request to stop back, as a new start does."""
    (runs / STOP_FILE).unlink(missing_ok=True)
