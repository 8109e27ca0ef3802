"""Copy captures from addresses to a local disk, and finished folders back (fsspec: s3, gs, abfs, https, sftp, ...)."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipelines.batch.jobs import Job
from pipelines.batch.records import JOB_FILE
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import read_json
from smplxpp.core.files.paths import path_inside
from smplxpp.core.lazy import import_extra

_LISTING = ".fetched.json"
_LEFT_OUT = ("capture", ".job.lock")
"""What is not sent back: a converted capture, which the address has in its own layout, and the lock."""


class Store:
    """Where a subject's capture lies on this machine.

    Args:
        job: the subject.
        folder: its folder in RUNS.
        scratch: folder on a local disk; empty: that of the system's temporary files.

    Attributes:
        local: folder of the capture, which `fetch` fills where the capture is at an address.
    """

    def __init__(self, job: Job, folder: Path, scratch: str) -> None:
        self.job, self.folder = job, folder
        # The same folder in every call on a machine, and another one for each batch.
        batch = hashlib.sha256(str(folder.parent).encode()).hexdigest()[:12]
        self._root = Path(scratch or tempfile.gettempdir()) / f"smplxpp-batch-{batch}" / job.subject
        self.local = str(self._root / "capture") if job.remote else job.capture

    def fetch(self, *, stop: Callable[[], bool]) -> None:
        """Copy the capture, unless it is here as the address lists it; a capture that is a folder must be there.

        Raises:
            InputError: no such capture, no right to read it, or no package for the address.
            OSError: a full disk, or a store that does not answer after some attempts.
        """
        if not self.job.remote:
            if self.job.capture and not Path(self.job.capture).exists():
                raise InputError(
                    f"capture of {self.job.subject}",
                    expected="the folder of a capture",
                    received=f"{self.job.capture}, which does not exist",
                    remedy="correct the job file, or mount the disk that it lies on, then `batch retry --failed`",
                )
            return
        attempts = 3
        for attempt in range(attempts):
            try:
                return self._fetch(stop)
            except (InputError, MissingExtraError):
                raise
            except OSError as error:
                if error.errno == errno.ENOSPC or attempt + 1 == attempts:
                    raise
                time.sleep(4.0**attempt)

    def send(self, address: str) -> None:
        """Copy the subject's folder to `address/SUBJECT`: its record last, which tells that the copy is whole."""
        files, target = open_address(address, purpose="results at addresses")
        names = [path.relative_to(self.folder) for path in sorted(self.folder.rglob("*")) if path.is_file()]
        names = [name for name in names if name.parts[0] not in _LEFT_OUT and name != Path(JOB_FILE)]
        root = f"{target.rstrip('/')}/{self.job.subject}"
        for name in [*names, Path(JOB_FILE)]:
            place = f"{root}/{name.as_posix()}"
            files.makedirs(place.rpartition("/")[0], exist_ok=True)
            files.put_file(str(self.folder / name), place)

    def clear(self) -> None:
        """Remove what was copied to the local disk."""
        if self.job.remote:
            shutil.rmtree(self._root, ignore_errors=True)

    def _fetch(self, stop: Callable[[], bool]) -> None:
        files, root = open_address(self.job.capture, purpose="captures at addresses")
        listed = _listing(files, root, self.job)
        local = Path(self.local)
        if _known(local / _LISTING) == listed:
            return
        # Ask for the space first: a disk that fills would take the commands of other subjects with it.
        self._root.mkdir(parents=True, exist_ok=True)
        needed, free = sum(size for size, _ in listed.values()), shutil.disk_usage(self._root).free
        if needed > 0.95 * free:
            raise OSError(errno.ENOSPC, f"{needed / 1e9:.1f} GB needed, {free / 1e9:.1f} GB free", str(self._root))
        # Files that a killed copy has finished stay; the folder appears under its name when it is whole.
        partial = self._root / "capture.part"
        begun = _known(partial / _LISTING)
        if begun != listed:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            atomic_write_text(partial / _LISTING, json.dumps(listed))
        for name, (size, _) in listed.items():
            place = path_inside(partial, name, subject=f"capture of {self.job.subject}")
            if stop():
                raise OSError(errno.EINTR, "stopped", str(partial))
            if place.is_file() and place.stat().st_size == size:
                continue
            place.parent.mkdir(parents=True, exist_ok=True)
            files.get_file(f"{root.rstrip('/')}/{name}", str(place.with_name(place.name + ".part")))
            os.replace(place.with_name(place.name + ".part"), place)
        shutil.rmtree(local, ignore_errors=True)
        os.replace(partial, local)


def open_address(address: str, *, purpose: str) -> tuple[Any, str]:
    """Return the file system of an address and the path in it.

    Raises:
        MissingExtraError: no fsspec.
        InputError: a kind of address without a package, or no credentials.
    """
    fsspec = import_extra("fsspec", extra="cluster", purpose=purpose)
    try:
        return fsspec.core.url_to_fs(address)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"address {address}",
            expected="a kind of address that fsspec has a package for",
            received=str(error),
            remedy="install the package that the message names, such as s3fs for s3:// or gcsfs for gs://",
        ) from None


def _listing(files: Any, root: str, job: Job) -> dict[str, list[Any]]:
    """Return [bytes, mark of the content] of each file at an address, by its path there."""
    try:
        found = files.find(root, detail=True)
    except (FileNotFoundError, PermissionError) as error:
        raise _unreadable(job, str(error) or type(error).__name__) from None
    except OSError:
        raise
    except Exception as error:
        # Packages of stores have errors of their own, such as for missing credentials.
        raise _unreadable(job, f"{type(error).__name__}: {error}") from error
    if not found:
        raise _unreadable(job, "nothing there")
    marks = ("ETag", "etag", "md5", "LastModified", "mtime", "last_modified")
    prefix = root.rstrip("/") + "/"
    return {
        name.removeprefix(prefix): [int(facts["size"] or 0), str(next((facts[m] for m in marks if m in facts), ""))]
        for name, facts in sorted(found.items())
        if name.startswith(prefix)
    }


def _unreadable(job: Job, received: str) -> InputError:
    return InputError(
        f"capture of {job.subject}",
        expected=f"files of a capture at {job.capture}",
        received=received,
        remedy="correct the address, or the credentials in the environment of the machines that run the jobs",
    )


def _known(path: Path) -> Any:
    """Return the listing that a copy was made from; None without one."""
    try:
        return read_json(path, subject="listing")
    except InputError:
        return None
