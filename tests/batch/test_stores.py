"""Captures at addresses come to a local disk whole or not at all, and finished folders go back."""

from __future__ import annotations

import errno
import json
import socket
from collections import namedtuple
from pathlib import Path

import pytest

from pipelines.batch import stores
from pipelines.batch.jobs import Job
from pipelines.batch.stores import Store
from smplxpp import InputError

fsspec = pytest.importorskip("fsspec")
FILES = {"cameras.json": b"{}", "rgbs/Cam1/0.jpg": b"jpeg", "rgbs/Cam1/1.jpg": b"other"}


@pytest.fixture
def memory():
    files = fsspec.filesystem("memory")
    for name, data in FILES.items():
        files.pipe_file(f"/studio/anna/{name}", data)
    yield files
    files.rm("/studio", recursive=True)


def files_of(folder: Path) -> dict[str, bytes]:
    found = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    return {name: data for name, data in found.items() if not name.startswith(".")}


def store_of(tmp_path: Path, address: str) -> Store:
    return Store(Job("anna", address), tmp_path / "runs" / "anna", str(tmp_path / "scratch"))


def test_a_capture_is_copied_once_and_goes_on_after_a_kill(tmp_path, memory, monkeypatch):
    store, fetched = store_of(tmp_path, "memory://studio/anna"), []
    get = type(memory).get_file
    stop_after = 1

    def counted(self, source, place, **options):
        fetched.append(source)
        return get(self, source, place, **options)

    monkeypatch.setattr(type(memory), "get_file", counted)
    with pytest.raises(OSError) as caught:
        store.fetch(stop=lambda: len(fetched) >= stop_after)
    assert caught.value.errno == errno.EINTR and not Path(store.local).exists()
    store.fetch(stop=lambda: False)
    assert files_of(Path(store.local)) == FILES and len(fetched) == 3
    store.fetch(stop=lambda: False)
    assert len(fetched) == 3
    # What changed at the address is copied again.
    memory.pipe_file("/studio/anna/rgbs/Cam1/2.jpg", b"a third")
    store.fetch(stop=lambda: False)
    assert len(files_of(Path(store.local))) == 4
    store.clear()
    assert not Path(store.local).exists()


def test_addresses_without_a_capture_and_disks_without_space_are_told(tmp_path, memory, monkeypatch):
    with pytest.raises(InputError, match="files of a capture at memory://studio/nobody"):
        store_of(tmp_path, "memory://studio/nobody").fetch(stop=lambda: False)
    with pytest.raises(InputError, match="fsspec has a package for"):
        store_of(tmp_path, "carrier-pigeon://studio/anna").fetch(stop=lambda: False)
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(stores.shutil, "disk_usage", lambda folder: usage(10, 9, 1))
    with pytest.raises(OSError, match="needed") as caught:
        store_of(tmp_path, "memory://studio/anna").fetch(stop=lambda: False)
    assert caught.value.errno == errno.ENOSPC


def test_a_finished_folder_is_copied_with_its_record_last(tmp_path, memory, monkeypatch):
    store = store_of(tmp_path, "memory://studio/anna")
    folder = tmp_path / "runs" / "anna"
    for name in ("run/60_assemble/smplxpp.npz", "capture/cameras.json", "job.json", "anna.avatar"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    sent, put = [], type(memory).put_file
    monkeypatch.setattr(type(memory), "put_file", lambda s, a, b, **o: (sent.append(b), put(s, a, b, **o))[1])
    store.send("memory://studio/results")
    assert sent[-1].endswith("/results/anna/job.json")
    assert {name.partition("results/")[2] for name in memory.find("/studio/results")} == {
        *("anna/anna.avatar", "anna/job.json", "anna/run/60_assemble/smplxpp.npz"),
    }


def test_s3_through_a_server_that_stands_for_it(tmp_path, monkeypatch):
    pytest.importorskip("s3fs")
    moto = pytest.importorskip("moto.server")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = moto.ThreadedMotoServer(port=port)
    server.start()
    try:
        for name, value in {
            "AWS_ACCESS_KEY_ID": "a",
            "AWS_SECRET_ACCESS_KEY": "b",
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "AWS_DEFAULT_REGION": "us-east-1",
        }.items():
            monkeypatch.setenv(name, value)
        files = fsspec.filesystem("s3", skip_instance_cache=True)
        files.mkdir("studio")
        for name, data in FILES.items():
            files.pipe_file(f"studio/anna/{name}", data)
        store = store_of(tmp_path, "s3://studio/anna")
        store.fetch(stop=lambda: False)
        assert files_of(Path(store.local)) == FILES
        (tmp_path / "runs/anna").mkdir(parents=True)
        (tmp_path / "runs/anna/job.json").write_text(json.dumps({}))
        store.send("s3://studio/results")
        assert files.cat_file("studio/results/anna/job.json") == b"{}"
        with pytest.raises(InputError, match="files of a capture at s3://studio/nobody"):
            store_of(tmp_path, "s3://studio/nobody").fetch(stop=lambda: False)
    finally:
        server.stop()
