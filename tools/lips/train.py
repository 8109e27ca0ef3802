"""Train the network from sound to lips, and write its weights as whole numbers of 8 bits.

    python -m tools.lips.train

A voice of CC0 says sentences of random words (`material`); each pass hears them from other mouths, rooms and
microphones (`augment`). Nothing else is learned from. Needs the extras `[avatar]` and `[talk]`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
import tyro
from jaxtyping import Float, Int
from rich.console import Console
from torch import Tensor, nn

from avatar.speech.audio_features import BANDS, FRAME, log_mel
from avatar.speech.coarticulation import ARTICULATORS
from avatar.speech.lips import PHONES, VERSION, WEIGHTS
from avatar.speech.phonemes import Speech
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.tensor_bytes import pack_tensors
from tools.lips.augment import disguise, vary
from tools.lips.material import STEP, Utterance, label, make_utterances

_FIRST, _MIDDLE = 5, 3  # widths of convolutions
_PIECE, _SKIPPED = 300, 40  # rows of a piece; those at its beginning that are not judged
_BATCH, _PASSES_OF_ONE = 24, 3  # a pass's sound is used so often, cut elsewhere
_FORGOTTEN = 0.1  # share of channels that a layer does without in training
_MOUTH = 2.0  # weight of the mouth's loss
_STEADY = 20.0  # weight of the loss of how the mouth changes from row to row: without it it trembles
_CLOSED = 1.5  # more weight of lips that are together: they are seldom, and a closure that is missed is seen
# Phonemes that look alike: to take one for another does less harm.
_ALIKE = (
    *("P B M", "F V", "TH DH", "T D N L", "K G NG HH", "S Z", "CH JH SH ZH", "R ER", "Y IY", "W UW UH"),
    *("AA AY AW", "AE", "AH", "EH", "EY IH", "AO OY OW"),
)


@dataclass(frozen=True)
class LipTraining:
    """Options of the training."""

    out: Path = WEIGHTS
    """Weights, in the layout of safetensors."""
    seed: int = 1
    """Of sentences, voices, rooms, and the network's first weights."""
    sentences: int = 700
    """How many are said: some forty minutes."""
    passes: int = 12
    """Times that all of them are heard anew."""
    width: int = 64
    """Channels of each layer."""
    delay: float = 0.06
    """Seconds before its last sample that a row tells of."""

    def run(self) -> None:
        """Say, hear, train, write."""
        console = Console(highlight=False)
        torch.set_num_threads(1)
        torch.manual_seed(self.seed)
        rng = np.random.default_rng(self.seed)
        began = time.process_time()
        utterances = make_utterances(self.sentences, self.seed)
        said = sum(one.speech.seconds for one in utterances)
        console.print(f"{said / 60.0:.0f} minutes said in {time.process_time() - began:.0f} s of CPU")
        network = Network(self.width)
        optimiser = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=1e-2)
        total = self.passes * _PASSES_OF_ONE
        for turn in range(total):
            if turn % _PASSES_OF_ONE == 0:
                rows, phones, mouth = _heard(utterances, rng, self.delay)
            share = turn / total
            rate = 4e-3 * min(1.0, (turn + 1) / (0.15 * total)) * 0.5 * (1.0 + np.cos(np.pi * share))
            for group in optimiser.param_groups:
                group["lr"] = rate
            losses = _pass(network, optimiser, (rows, phones, mouth), offset=int(rng.integers(_PIECE)))
            spent = time.process_time() - began
            console.print(
                f"pass {turn + 1} of {total}: phonemes {losses[0]:.3f}, mouth {losses[1]:.4f}; {spent:.0f} s of CPU"
            )
        about = {"version": VERSION, "delay": self.delay, "dilations": list(Network.DILATIONS), "phones": list(PHONES)}
        atomic_write_bytes(self.out, pack_tensors(network.tensors(), about))
        console.print(f"{self.out}: {self.out.stat().st_size} bytes")


class Network(nn.Module):
    """`avatar.speech.lips.LipNetwork`, to be trained."""

    DILATIONS = (1, 2, 4, 8, 16)

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv1d(BANDS, width, _FIRST)
        self.middle = nn.Sequential(*(nn.Conv1d(width, width, _MIDDLE, dilation=one) for one in self.DILATIONS))
        self.forget = nn.Dropout1d(_FORGOTTEN)
        self.last = nn.Conv1d(width, len(PHONES) + len(ARTICULATORS), 1)

    def forward(self, rows: Float[Tensor, "B 32 T"]) -> Float[Tensor, "B 46 T"]:
        """Return logits of phonemes and of the mouth."""
        h = torch.relu(self.first(nn.functional.pad(rows, (_FIRST - 1, 0))))
        for layer, reach in zip(self.middle, self.DILATIONS, strict=True):
            h = torch.relu(h + layer(nn.functional.pad(self.forget(h), ((_MIDDLE - 1) * reach, 0))))
        return self.last(h)

    def tensors(self) -> dict[str, np.ndarray]:
        """Return weights as whole numbers of 8 bits with a scale an output."""
        out = {}
        layers = {"first": self.first, **{f"middle{k}": one for k, one in enumerate(self.middle)}, "last": self.last}
        for name, module in layers.items():
            layer = cast(nn.Conv1d, module)
            weight = layer.weight.detach().numpy()
            scale = np.maximum(np.abs(weight).max(axis=(1, 2)) / 127.0, 1e-12)
            out[f"{name}.weight"] = np.round(weight / scale[:, None, None]).astype(np.int8)
            out[f"{name}.scale"] = scale.astype(np.float32)
            out[f"{name}.bias"] = cast(Tensor, layer.bias).detach().numpy().astype(np.float32)
        return out


_Rows = tuple[Float[np.ndarray, "T 32"], Int[np.ndarray, " T"], Float[np.ndarray, "T 6"]]


def _heard(utterances: list[Utterance], rng: np.random.Generator, delay: float) -> _Rows:
    """All sentences behind each other in another order, each varied: what is heard, phonemes, mouth."""
    rows, phones, mouths = [], [], []
    for k in rng.permutation(len(utterances)):
        one = utterances[k]
        got = vary(one.samples, rng)
        rows.append(disguise(log_mel(got.samples.astype(np.float32)), rng))
        times = ((np.arange(len(rows[-1])) + 1) * FRAME - delay - got.ahead) * got.faster
        phones.append(_labels(one.speech, times))
        at = np.arange(len(one.mouth)) * STEP
        columns = [np.interp(times, at, column, left=0.0, right=0.0) for column in one.mouth.T]
        mouths.append(np.stack(columns, axis=1).astype(np.float32))
    return np.concatenate(rows), np.concatenate(phones), np.concatenate(mouths)


def _labels(speech: Speech, times: Float[np.ndarray, " T"]) -> Int[np.ndarray, " T"]:
    return label(speech, times, list(PHONES))


def _pass(network: Network, optimiser: torch.optim.Optimizer, heard: _Rows, *, offset: int) -> tuple[float, float]:
    """Take a step for each batch; return the mean losses."""
    count = (len(heard[0]) - offset) // _PIECE

    def pieces(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values[offset : offset + count * _PIECE]).unflatten(0, (count, _PIECE))

    rows, phones, mouth = (pieces(one) for one in heard)
    alike = _alike()
    pressed = torch.tensor([float(name == "press") for name in ARTICULATORS])
    losses = []
    for batch in torch.randperm(count).split(_BATCH):
        out = network(rows[batch].transpose(1, 2))[:, :, _SKIPPED:].transpose(1, 2)
        truth = phones[batch][:, _SKIPPED:]
        logs = torch.log_softmax(out[..., : len(PHONES)], dim=-1)
        exact = nn.functional.nll_loss(logs.flatten(0, 1), truth.flatten())
        seen = torch.log(logs.exp() @ alike + 1e-6)
        looks = nn.functional.nll_loss(seen.flatten(0, 1), alike.argmax(dim=1)[truth].flatten())
        wanted = mouth[batch][:, _SKIPPED:]
        weight = 1.0 + _CLOSED * wanted * pressed
        moved = nn.functional.binary_cross_entropy_with_logits(out[..., len(PHONES) :], wanted, weight=weight)
        steps = torch.diff(torch.sigmoid(out[..., len(PHONES) :]), dim=1) - torch.diff(wanted, dim=1)
        optimiser.zero_grad()
        (0.5 * exact + 0.5 * looks + _MOUTH * moved + _STEADY * steps.square().mean()).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        losses.append((float(exact.detach()), float(moved.detach())))
    first, second = np.mean(losses, axis=0)
    return float(first), float(second)


def _alike() -> Float[Tensor, "40 G"]:
    """Which phonemes belong to which look; silence is one of its own."""
    groups = [one.split() for one in ("SIL", *_ALIKE)]
    return torch.tensor([[float(name in group) for group in groups] for name in PHONES])


if __name__ == "__main__":
    tyro.cli(LipTraining, prog="python -m tools.lips.train").run()
