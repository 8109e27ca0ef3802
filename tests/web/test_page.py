"""Pages as files, and the server: what they hold, and what they refuse."""

from __future__ import annotations

import http.client
import re
import threading
from collections.abc import Iterator

import pytest

from pipelines.cli import main
from pipelines.web.page import PageContent, page_files, single_page, write_page_folder
from pipelines.web.server import PageServer, answer
from smplxpp.core.errors import InputError
from tests.web.avatars import write_avatar
from tests.web.chromium import Page, find_chromium

FILES = {"index.html": b"<p>page", "player.js": b"let a", "me.avatar": b"bundle"}


@pytest.fixture
def server() -> Iterator[PageServer]:
    with PageServer(FILES) as it:
        threading.Thread(target=it.serve_forever, daemon=True).start()
        yield it
        it.shutdown()


def get(server: PageServer, path: str, method: str = "GET", host: str | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(*server.server_address, timeout=900)
    connection.request(method, path, headers={} if host is None else {"Host": host})
    response = connection.getresponse()
    response.content = response.read()
    connection.close()
    return response


def test_the_server_gives_the_page_and_the_bundle_and_isolates_them(server):
    for path, name in (("/", "index.html"), ("/index.html?renderer=webgl2", "index.html"), ("/me.avatar", "me.avatar")):
        response = get(server, path)
        assert (response.status, response.content) == (200, FILES[name])
        assert response.headers["Cross-Origin-Opener-Policy"] == "same-origin"
        assert response.headers["Cross-Origin-Embedder-Policy"] == "require-corp"
    assert get(server, "/player.js").headers["Content-Type"].startswith("text/javascript")
    head = get(server, "/me.avatar", "HEAD")
    assert head.content == b"" and head.headers["Content-Length"] == str(len(FILES["me.avatar"]))


@pytest.mark.parametrize(
    "path", ["/../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/page.py", "/me.avatar/"]
)
def test_the_server_gives_nothing_else(server, path):
    assert get(server, path).status == 404
    assert answer(FILES, server.hosts, "http://[", next(iter(server.hosts)))[0] == 404


def test_the_server_answers_this_machine_alone(server):
    assert server.server_address[0] == "127.0.0.1"
    assert get(server, "/", host="evil.example").status == 403
    assert get(server, "/", "POST").status == 501


def test_a_taken_port_gives_way_to_the_next(server):
    with PageServer(FILES, port=server.server_address[1]) as second:
        assert second.server_address[1] > server.server_address[1]


def test_a_folder_keeps_what_else_is_in_it(tmp_path):
    (tmp_path / "mine.txt").write_text("kept")
    paths = write_page_folder(tmp_path, b"bundle", PageContent(name="A & B"))
    assert sorted(path.name for path in paths) == ["index.html", "me.avatar", "player.js"]
    assert (tmp_path / "mine.txt").read_text() == "kept"
    assert "<title>A &amp; B</title>" in (tmp_path / "index.html").read_text()


@pytest.mark.skipif(find_chromium() is None, reason="no Chromium")
def test_a_folder_opened_from_disk_says_what_it_needs(tmp_path):
    write_page_folder(tmp_path / "site", b"bundle", PageContent(name="A", sound=b"RIFF", lips=b"lips"))
    with Page(tmp_path / "profile", flags=("--disable-gpu",)) as page:
        page.go((tmp_path / "site" / "index.html").as_uri())
        page.until("/opened from disk.*--single-file/.test(document.body.innerText.replace(/\\n/g, ' '))")
        assert not [one for one in page.errors if "Uncaught" in one]


def test_a_single_page_refers_to_nothing_outside():
    page = single_page(b"\0\1bundle", PageContent(name="</title><script>")).decode()
    assert "</title><script>" not in page
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page.split("<script>")[0])
    assert page.count("</script>") == 2
    assert page_files(b"", PageContent(name="x")).keys() == {"index.html", "player.js", "me.avatar"}


def test_the_command_writes_a_folder_and_a_file(tmp_path):
    avatar = tmp_path / "doll.avatar"
    data = write_avatar(avatar)
    out, single = tmp_path / "site", tmp_path / "one.html"
    assert main(["web", str(avatar), "--out", str(out), "--single-file", str(single)]) == 0
    assert (out / "me.avatar").read_bytes() == data
    assert single.stat().st_size > len(data) * 4 / 3


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ([], "one of them"),
        (["--single-file", "page.txt"], ".html"),
        (["--out", "doll.avatar"], "a folder"),
        (["--serve", "--port", "0"], "port"),
        (["--out", "site", "--licence", "CC0"], "a run"),
    ],
)
def test_the_command_refuses(tmp_path, monkeypatch, capsys, options, word):
    monkeypatch.chdir(tmp_path)
    write_avatar(tmp_path / "doll.avatar")
    assert main(["web", "doll.avatar", *options]) == 2
    assert word in capsys.readouterr().err


def test_the_command_refuses_what_is_no_bundle(tmp_path, capsys):
    (tmp_path / "doll.avatar").write_bytes(b"no zip")
    assert main(["web", str(tmp_path / "doll.avatar"), "--out", str(tmp_path / "site")]) == 2
    assert "avatar" in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


def test_no_port_is_an_error(monkeypatch):
    def taken(*_: object) -> None:
        raise OSError(98, "taken")

    monkeypatch.setattr("http.server.ThreadingHTTPServer.__init__", taken)
    with pytest.raises(InputError, match="port"):
        PageServer(FILES, port=8090)
