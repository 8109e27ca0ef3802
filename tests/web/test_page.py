"""Pages as files, and the server: what they hold, and what they refuse."""

from __future__ import annotations

import http.client
import re
import socket
import threading
from collections.abc import Iterator

import pytest

from pipelines.cli import main
from pipelines.web.access import Access, new_token
from pipelines.web.page import PageContent, page_files, single_page, write_page_folder
from pipelines.web.server import PageServer
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


def get(
    server: PageServer, path: str, method: str = "GET", host: str | None = None, cookie: str = ""
) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(*server.server_address, timeout=900)
    connection.request(method, path, headers=({} if host is None else {"Host": host}) | {"Cookie": cookie})
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


def test_the_server_answers_this_machine_alone(server):
    assert server.server_address[0] == "127.0.0.1"
    assert get(server, "/", host="evil.example").status == 403
    assert get(server, "/", "POST").status == 405


@pytest.mark.parametrize(
    ("access", "host", "origin", "known", "own"),
    [
        ({}, "localhost:9000", "http://localhost:9000", True, True),  # a forwarded port: ssh -L 9000:localhost:8091
        ({}, "localhost:8091", "http://localhost:3000", True, False),  # another server's page on this machine
        ({}, "[::1]:8091", "http://[::1]:8091", True, True),
        ({}, "192.168.0.7:8091", "http://192.168.0.7:8091", False, False),
        ({}, "localhost.evil.example", "", False, False),
        ({}, "", "", False, False),
        ({}, "localhost:8091, evil.example", "", False, False),
        ({"host": "0.0.0.0"}, "192.168.0.7:8091", "http://192.168.0.7:8091", True, True),
        ({"host": "0.0.0.0"}, "evil.example:8091", "http://evil.example:8091", False, False),
        ({"public_url": "https://me.org/a"}, "me.org", "https://me.org", True, True),
        (
            {"public_url": "https://me.org/a"},
            "127.0.0.1:8091",
            "https://me.org",
            True,
            True,
        ),  # proxies may not pass Host
        ({"public_url": "https://me.org/a"}, "me.org", "https://evil.example", True, False),
        ({"public_url": "https://me.org/a"}, "me.org", "", True, False),
    ],
)
def test_a_server_knows_its_names_and_its_own_pages(access, host, origin, known, own):
    it = Access(**access)
    assert (it.knows(host), it.own_page(host, origin)) == (known, own)


@pytest.mark.parametrize(
    "options",
    [{"host": "example.org"}, {"public_url": "me.org"}, {"public_url": "https://me.org/?a"}, {"token": "short"}],
)
def test_what_is_no_address_or_can_be_guessed_is_refused(options):
    with pytest.raises(InputError, match=next(iter(options)).replace("_", "-")):
        Access(**options)


def test_a_token_goes_from_the_address_into_a_cookie():
    access = Access(public_url="https://me.org/a/", token=new_token())
    with PageServer(FILES, access=access) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        assert server.address == f"https://me.org/a/?token={access.token}" and access.token not in repr(access)
        assert get(server, "/").status == get(server, "/a/me.avatar").status == 403
        assert get(server, "/?token=" + new_token()).status == 403
        moved = get(server, f"/a/?token={access.token}")
        assert moved.status == 303 and moved.headers["Location"] == "./"
        assert get(server, f"/%0d%0aX:y?{'a&' * 99}token={access.token}").headers["X"] is None
        cookie, *rules = moved.headers["Set-Cookie"].split("; ")
        assert set(rules) == {"HttpOnly", "SameSite=Lax", "Path=/a/", "Secure"}
        # A proxy passes the path of the public address on, or leaves it out.
        for path in ("/a/me.avatar", "/me.avatar"):
            assert get(server, path, cookie=f"other=1; {cookie}").content == FILES["me.avatar"]


def test_half_requests_and_pages_that_do_not_read_hold_no_thread(caplog):
    with PageServer(FILES | {"big": bytes(8 << 20)}) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        assert get(server, "/").status == 200
        before, open_ones = threading.active_count(), []
        for text in ("GET / HTTP/1.1\r\nHost: 127", "", "GET /big HTTP/1.1\r\nHost: localhost\r\n\r\n") * 20:
            open_ones.append(socket.create_connection(server.server_address))
            open_ones[-1].sendall(text.encode())
        assert get(server, "/me.avatar").content == FILES["me.avatar"]
        assert threading.active_count() == before
        for one in open_ones:
            one.close()
        assert get(server, "/player.js").content == FILES["player.js"]
    assert not caplog.records  # browsers that leave early are no errors


@pytest.mark.parametrize(
    ("raw", "status"),
    [
        (b"GET http://[ HTTP/1.1\r\nHost: localhost\r\n\r\n", b"404"),
        (b"GET /\xff\xfe HTTP/1.1\r\nHost: localhost\r\n\r\n", b"404"),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\nHost : localhost\r\n\r\n", b"400"),
        (b"\x16\x03\x01 tls\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\nCookie: " + b"x" * 40_000, b"431"),
    ],
)
def test_what_is_no_request_is_answered_with_what_is_wrong(server, raw, status):
    with socket.create_connection(server.server_address, timeout=900) as stream:
        stream.sendall(raw)
        assert stream.recv(64).split()[1] == status


def test_a_taken_port_gives_way_to_the_next(server):
    with PageServer(FILES, port=server.server_address[1]) as second:
        assert second.server_address[1] > server.server_address[1]
    with pytest.raises(InputError, match="proxy"):  # a proxy would ask another server
        PageServer(FILES, port=server.server_address[1], access=Access(public_url="https://me.org/"))


def test_a_folder_keeps_what_else_is_in_it(tmp_path):
    (tmp_path / "mine.txt").write_text("kept")
    paths = write_page_folder(tmp_path, b"bundle", PageContent(name="A & B"))
    assert sorted(path.name for path in paths) == ["index.html", "me.avatar", "player.js"]
    assert (tmp_path / "mine.txt").read_text() == "kept"
    assert "<title>A &amp; B</title>" in (tmp_path / "index.html").read_text()


@pytest.mark.skipif(find_chromium() is None, reason="no Chromium")
@pytest.mark.long
def test_a_folder_opened_from_disk_says_what_it_needs(tmp_path):
    write_page_folder(tmp_path / "site", b"bundle", PageContent(name="A", sound=b"RIFF", lips=b"lips"))
    with Page(tmp_path / "profile", flags=("--disable-gpu",)) as page:
        page.go((tmp_path / "site" / "index.html").as_uri())
        page.until("/opened from disk.*--single-file/.test(document.body.innerText.replace(/\\n/g, ' '))")
        assert not [one for one in page.errors if "Uncaught" in one]


def test_a_single_page_refers_to_nothing_outside():
    page = single_page(b"\0\1bundle", PageContent(name="</title><script>")).decode()
    assert "</title><script>" not in page
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page.split('<script type="module">')[0])
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

    monkeypatch.setattr("socket.socket.bind", taken)
    with pytest.raises(InputError, match="port"):
        PageServer(FILES, port=8090)
