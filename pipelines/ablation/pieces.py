"""What an ablation trains: pieces that its rows share, each made once, saved and read again by itself."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from safetensors.torch import load, save
from torch import Tensor

from avatar.baselines.avatar_base import Baseline
from avatar.baselines.build import BaselineConfig, make_baseline
from avatar.baselines.outer_template import outer_template
from avatar.baselines.photograph_task import PhotographConfig, PhotographTask
from avatar.data.sequence import AvatarSequence
from avatar.data.views import read_views
from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.bound_file import load_bound, save_bound
from avatar.models.model_file import load_avatar, save_avatar
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.deformation_field import show_null_code
from avatar.models.networks.teacher import TeacherConfig
from avatar.models.student import Student, StudentConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.rig.rig import Rig
from avatar.training.engine.device import fixed_seed
from avatar.training.engine.loop import Progress
from avatar.training.reference_fit.config import FitConfig
from avatar.training.reference_fit.fit import FitScene, fit_reference
from avatar.training.student.bake import BakeConfig
from avatar.training.student.compensate import CompensateConfig
from avatar.training.student.prune import coefficient_std, pruned_to
from avatar.training.teacher.fit_teacher import FitTeacherConfig
from avatar.training.train import Session, bake, compensate, fit_teacher
from smplxpp.capture import Capture
from smplxpp.core.atomic import atomic_write_bytes
from smplxpp.template.template import Template

CLOTHED, NAKED, OUTER = "clothed", "naked", "outer"
GROUNDS: Mapping[str, Callable[[Template], Template]] = {
    CLOTHED: lambda template: template,
    NAKED: Template.naked,
    OUTER: outer_template,
}
"""Templates that pieces are trained on, made from the person's."""


@dataclass(frozen=True, eq=False)
class Workshop:
    """The capture and the person that all pieces are trained on.

    Attributes:
        capture: with cameras, images, masks and parameters. template: of the person.
        device: of all tensors.
    """

    capture: Capture
    template: Template
    device: str = "cpu"
    _sequences: dict[str, AvatarSequence] = field(default_factory=dict, init=False, repr=False)

    def sequence(self, ground: str) -> AvatarSequence:
        """The capture seen with one of the templates of `GROUNDS`; they share its images."""
        if ground not in self._sequences:
            template = GROUNDS[ground](self.template)
            self._sequences[ground] = AvatarSequence(self.capture, template, device=self.device)
        return self._sequences[ground]


Get = Callable[[str], Any]
"""A finished piece by its name, read from its file."""


@dataclass(frozen=True, kw_only=True)
class Piece(ABC):
    """Something trained once. Its fields and those of the pieces it needs decide what comes out.

    Attributes:
        ground: template that it is trained on.
    """

    ground: str = CLOTHED

    @property
    @abstractmethod
    def needs(self) -> tuple[str, ...]:
        """Names of the pieces that it is made from."""

    @abstractmethod
    def make(self, shop: Workshop, get: Get, session: Session) -> tuple[Any, Progress | None]:
        """Train it, from the session's checkpoint if there is one; None for the progress of what needs no steps."""

    def write(self, product: Any, path: Path, *, compact: bool = False) -> None:
        """Save what `make` gave; `compact`: in half precision, as a player needs it."""
        save_avatar(path, product, compact=compact)

    def read(self, path: Path, shop: Workshop, get: Get) -> Any:
        """What `write` saved."""
        return load_avatar(path, shop.sequence(self.ground).rig)


@dataclass(frozen=True, kw_only=True)
class FitPiece(Piece):
    """Gaussians fitted to one frame's photographs."""

    config: FitConfig
    frame: int

    @property
    def needs(self) -> tuple[str, ...]:
        return ()

    def make(self, shop: Workshop, get: Get, session: Session) -> tuple[BoundGaussians, Progress]:
        sequence = shop.sequence(self.ground)
        template = sequence.rig.template
        views = read_views(shop.capture, self.frame, sequence.train_cameras)
        scene = FitScene(
            template, template.pose(shop.capture.params(self.frame))[0], views, (), tuple(sequence.background.tolist())
        )
        result = fit_reference(
            scene,
            self.config,
            session.folder,
            key=session.key,
            device=shop.device,
            max_seconds=session.max_seconds,
            report=session.report,
        )
        return result.gaussians, result.progress

    def write(self, product: BoundGaussians, path: Path, *, compact: bool = False) -> None:
        save_bound(product, path)

    def read(self, path: Path, shop: Workshop, get: Get) -> BoundGaussians:
        rig = shop.sequence(self.ground).rig
        return load_bound(path, faces=rig.template.faces).to(device=rig.device)


@dataclass(frozen=True, kw_only=True)
class TeacherPiece(Piece):
    """A teacher on fitted Gaussians."""

    gaussians: str
    networks: TeacherConfig
    config: FitTeacherConfig

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.gaussians,)

    def make(self, shop: Workshop, get: Get, session: Session) -> tuple[TeacherAvatar, Progress]:
        return fit_teacher(shop.sequence(self.ground), get(self.gaussians), self.networks, self.config, session)


@dataclass(frozen=True, kw_only=True)
class BakePiece(Piece):
    """A student before its blend shapes: field and attributes from a teacher, or from photographs.

    Attributes:
        source: a teacher, whose Gaussians it starts from too; or Gaussians, to learn from photographs.
    """

    source: str
    student: StudentConfig
    config: BakeConfig

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.source,)

    def make(self, shop: Workshop, get: Get, session: Session) -> tuple[Student, Progress]:
        source, sequence = get(self.source), shop.sequence(self.ground)
        teacher = source if isinstance(source, TeacherAvatar) else None
        gaussians = source if teacher is None else teacher.gaussians.snapshot()
        return bake(sequence, gaussians, self.student, self.config, session, teacher=teacher)


@dataclass(frozen=True, kw_only=True)
class CompensatePiece(Piece):
    """A baked student with trained blend shapes.

    Attributes:
        teacher: whose followed surface seeds them; none without a name.
    """

    student: str
    teacher: str = ""
    shapes: BlendShapeConfig
    config: CompensateConfig

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.student, self.teacher) if self.teacher else (self.student,)

    def make(self, shop: Workshop, get: Get, session: Session) -> tuple[Student, Progress]:
        sequence = shop.sequence(self.ground)
        shapes, teacher = fitting(self.shapes, sequence.rig), get(self.teacher) if self.teacher else None
        return compensate(sequence, get(self.student), shapes, self.config, session, teacher=teacher)


@dataclass(frozen=True, kw_only=True)
class PrunedPiece(Piece):
    """A student whose least important Gaussians lost their blend shapes.

    Attributes:
        keep: share of the Gaussians that keep theirs, or less: the compact file has at most `max_bytes`.
    """

    student: str
    keep: float
    max_bytes: float

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.student,)

    def make(self, shop: Workshop, get: Get, session: Session) -> tuple[Student, None]:
        student, sequence = get(self.student), shop.sequence(self.ground)
        shapes = student.blend_shapes.pruned(coefficient_std(student, sequence), keep=self.keep)
        small, _ = pruned_to(student.with_blend_shapes(shapes), sequence, self.max_bytes)
        return small.eval(), None


@dataclass(frozen=True, kw_only=True)
class BaselinePiece(Piece):
    """An avatar of another kind, trained on photographs."""

    gaussians: str
    model: BaselineConfig
    config: PhotographConfig

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.gaussians,)

    def make(self, shop: Workshop, get: Get, session: Session) -> tuple[Baseline, Progress]:
        sequence = shop.sequence(self.ground)
        with fixed_seed(self.config.seed):
            model = self._untrained(shop, get)
        progress = session.run(lambda: PhotographTask(sequence, model, self.config, session.context), self.config)
        return model.eval(), progress

    def write(self, product: Baseline, path: Path, *, compact: bool = False) -> None:
        tensors = {name: value.detach().cpu().contiguous() for name, value in product.state_dict().items()}
        if compact:
            tensors = {name: _halved(value) for name, value in tensors.items()}
        atomic_write_bytes(path, save(tensors))

    def read(self, path: Path, shop: Workshop, get: Get) -> Baseline:
        model = self._untrained(shop, get)
        model.load_state_dict(load(path.read_bytes()))  # casts what is in half precision
        return model.eval()

    def _untrained(self, shop: Workshop, get: Get) -> Baseline:
        sequence = shop.sequence(self.ground)
        model = make_baseline(self.model, sequence.rig, get(self.gaussians), sequence.train_frames)
        if self.config.null_share:
            show_null_code(model)
        return model


@dataclass(frozen=True, kw_only=True)
class SamePiece(Piece):
    """A student that another piece has already made."""

    student: str

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.student,)

    def make(self, shop: Workshop, get: Get, session: Session) -> tuple[Student, None]:
        return get(self.student), None


def fitting(shapes: BlendShapeConfig, rig: Rig) -> BlendShapeConfig:
    """Blend shapes driven by as many expressions as the body has."""
    return replace(shapes, expression_size=rig.expression_size)


def _halved(value: Tensor) -> Tensor:
    """As a player's file has it."""
    return value.half() if value.is_floating_point() else value.int()
