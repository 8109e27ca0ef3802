"""What the examples deploy: the image as its Dockerfile is written, the site of nginx, a server that is told to end."""

from __future__ import annotations

import http.client
import json
import os
import re
import shlex
import signal
import socket
import ssl
import subprocess
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import which
from types import SimpleNamespace
from typing import Any

import pytest
import tyro

from tests.conversation.actors import cast, doll

pytest.importorskip("websockets", reason="extra chat")

from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from pipelines.commands.chat import Chat
from pipelines.web.access import Access, new_token
from pipelines.web.chat_server import ChatServer
from pipelines.web.server import PageServer
from tests.web.test_chat_server import LIMIT, ROOT, told

COMPILES = {"build-essential", "g++", "gcc", "clang", "cmake", "ninja-build", "python3-dev", "python3-venv"}


@pytest.fixture(scope="module")
def stages() -> list[list[tuple[str, str]]]:
    """Instructions of the image and what they are given, a list a stage."""
    text = (ROOT / "examples" / "deploy" / "Dockerfile").read_text()
    lines = re.sub(r"\\\n\s*", "", re.sub(r"^#.*\n", "", text, flags=re.MULTILINE)).splitlines()
    found: list[list[tuple[str, str]]] = []
    for line in filter(None, lines):
        word, _, rest = line.partition(" ")
        if word == "FROM":
            found.append([])
        found[-1].append((word, rest))
    return found


def packages(stage: list[tuple[str, str]]) -> set[str]:
    """Debian's packages that a stage installs."""
    runs = " && ".join(rest for word, rest in stage if word == "RUN").split("&&")
    installs = [shlex.split(run) for run in runs if run.split()[:2] == ["apt-get", "install"]]
    return {word for install in installs for word in install[2:] if not word.startswith("-")}


def test_the_image_has_no_compiler_and_no_rights(stages):
    build, last = stages
    assert [build[0][1].split()[0]] == last[0][1].split()  # one release: the environment of one Python works in both
    assert {"g++", "cmake", "python3-dev"} <= packages(build) and not packages(last) & COMPILES
    assert {"espeak-ng", "ca-certificates"} <= packages(last)  # without the latter no model behind https was reached
    assert all(rest.startswith("--from=build /opt/smplxpp ") for word, rest in last if word == "COPY")
    words = [word for word, _ in last]
    (user,) = (rest for word, rest in last if word == "USER")
    assert words.index("USER") < words.index("ENTRYPOINT")
    assert re.search(rf"useradd --system .*\b{user}\b", dict(last)["RUN"]) and user != "root"


def test_the_image_installs_what_a_conversation_needs(stages):
    """The extra `chat`, but for torch, which a package of it asks for in vain."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    runs = " && ".join(rest for word, rest in stages[0] if word == "RUN").split("&&")
    pips = [shlex.split(run) for run in runs if "/pip install" in run]
    asked = [word for pip in pips for word in pip if re.search(r"[\[>=]", word)]
    assert [word.replace("/src[", "smplxpp[") for word in asked] == extras["chat"]
    (alone,) = (pip for pip in pips if "--no-deps" in pip)
    assert any(word.startswith("silero-vad") for word in alone)
    # In the versions that the tests were run with.
    assert all(pip[pip.index("-c") + 1] == "/src/constraints.txt" for pip in pips)


def test_the_image_starts_what_its_first_lines_say(stages):
    text = (ROOT / "examples" / "deploy" / "Dockerfile").read_text()
    example = " ".join(line.lstrip("# ") for line in text.split("FROM")[0].splitlines()).replace("\\ ", "")
    (run,) = re.findall(r"docker run (.*?)smplxpp-chat (--public-url \S+ --sessions \d+)", example)
    program, command, *options = json.loads(dict(stages[1])["ENTRYPOINT"])
    assert (program, command) == ("/opt/smplxpp/bin/smplxpp", "chat")
    chat = tyro.cli(Chat, args=[*options, *run[1].split()])
    assert chat.serve and chat.no_browser and chat.exposure.host == "0.0.0.0" and chat.sessions > 1
    assert dict(stages[1])["EXPOSE"] == str(chat.port) and f":{chat.port}:{chat.port} " in run[0]
    assert f':{chat.source}:ro" ' in run[0]


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_server_ends_when_a_container_is_stopped():
    """The first process of a container ignores SIGTERM unless it asks for it: stopping one took ten seconds."""
    server = PageServer({"index.html": b""})
    ended = threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM))
    before = signal.signal(signal.SIGTERM, lambda *_: pytest.fail("the server does not ask for it"))
    try:
        ended.start()
        server.serve_forever()
        assert server._ended.is_set()
    finally:
        signal.signal(signal.SIGTERM, before)


NGINX = """daemon off; master_process off; worker_processes 1; pid {folder}/pid; error_log {folder}/errors.log;
events {{}}
http {{
  client_body_temp_path {folder}/body; proxy_temp_path {folder}/proxy; fastcgi_temp_path {folder}/fast;
  uwsgi_temp_path {folder}/uwsgi; scgi_temp_path {folder}/scgi;
  types {{ text/html html; text/javascript js; }}
{site}
}}"""


NEEDS_NGINX = pytest.mark.skipif(
    not (which("nginx") and which("openssl")), reason="no nginx, or no openssl (apt-get install nginx)"
)
PROXIED = "me.example.org"
"""The name of the site that the examples write."""


@contextmanager
def behind_nginx(folder: Path, token: str | None = None, **changes: Any) -> Iterator[SimpleNamespace]:
    """The site of the examples as it is written, with another port, certificate and folder, before a conversation.

    A page of somebody's own is in the folder www.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    made = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2".split()
    made += ["-subj", f"/CN={PROXIED}", "-addext", f"subjectAltName=DNS:{PROXIED}"]
    made += ["-keyout", str(folder / "key.pem"), "-out", str(folder / "cert.pem")]
    subprocess.run(["openssl", *made], check=True, capture_output=True)
    base, token = f"https://{PROXIED}:{port}", new_token() if token is None else token
    data, body = doll(folder)
    access = Access(public_url=f"{base}/talk/", token=token)
    server = ChatServer(data, cast(body, **changes), name="Doll", access=access)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    site = (ROOT / "examples" / "deploy" / "nginx.conf").read_text()
    for written, here in (
        ("listen 443", f"listen 127.0.0.1:{port}"),
        ("127.0.0.1:8091", f"127.0.0.1:{server.server_address[1]}"),
        (f"/etc/letsencrypt/live/{PROXIED}/fullchain.pem", str(folder / "cert.pem")),
        (f"/etc/letsencrypt/live/{PROXIED}/privkey.pem", str(folder / "key.pem")),
        ("/var/log/nginx", str(folder)),
        (f"# root /var/www/{PROXIED}", f"root {folder}/www"),
    ):
        assert written in site
        site = site.replace(written, here)
    (folder / "nginx.conf").write_text(NGINX.format(folder=folder, site=site))
    command = ["nginx", "-p", str(folder), "-c", str(folder / "nginx.conf"), "-e", str(folder / "errors.log")]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as nginx:
        try:
            end = time.monotonic() + LIMIT
            while True:  # until it listens
                try:
                    assert nginx.poll() is None and time.monotonic() < end, (folder / "errors.log").read_text()
                    socket.create_connection(("127.0.0.1", port)).close()
                    break
                except ConnectionError:
                    time.sleep(0.02)
            yield SimpleNamespace(base=base, port=port, token=token, data=data, server=server)
        finally:
            nginx.terminate()
            server.shutdown()


@NEEDS_NGINX
def test_the_nginx_of_the_examples_offers_it_by_https(tmp_path):
    with behind_nginx(tmp_path) as it:
        trusted = ssl.create_default_context(cafile=tmp_path / "cert.pem")

        def get(path: str, **headers: str) -> http.client.HTTPResponse:
            connection = http.client.HTTPSConnection(PROXIED, it.port, timeout=LIMIT, context=trusted)
            stream = socket.create_connection(("127.0.0.1", it.port), timeout=LIMIT)
            connection.sock = trusted.wrap_socket(stream, server_hostname=PROXIED)
            connection.request("GET", path, headers=headers)
            reply = connection.getresponse()
            reply.content = reply.read()
            connection.close()
            return reply

        moved = get(f"/talk/?token={it.token}")
        assert moved.status == 303 and get("/talk/").status == 403 and get("/other").status == 404
        cookie = moved.headers["Set-Cookie"].split(";")[0]
        page = get("/talk/", Cookie=cookie)
        assert f"wss://{PROXIED}:{it.port}" in page.content.decode()
        assert get("/talk/me.avatar", Cookie=cookie).content == it.data
        secret = re.search('data-chat="([^"]+)"', page.content.decode())[1]

        def open_socket(origin: str) -> Any:
            stream = socket.create_connection(("127.0.0.1", it.port))
            options: dict[str, Any] = {"additional_headers": {"Cookie": cookie}, "max_size": None, "ssl": trusted}
            return connect(f"wss://{PROXIED}:{it.port}/talk/{secret}", sock=stream, origin=origin, **options)

        with pytest.raises(InvalidStatus, match="403"):
            open_socket("https://evil.example")
        with open_socket(it.base) as talk:
            talk.send(json.dumps({"kind": "say", "text": "hello"}))
            assert told(talk, "heard")["text"] == "hello"
    assert it.token not in (tmp_path / "smplxpp.log").read_text()  # the log does not let its readers in
