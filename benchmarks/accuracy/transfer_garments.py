"""Measure skin-weight transfer on garments that no setting was chosen on: weights and driven positions.

    python -m benchmarks transfer_garments [--shapes 3] [--poses T A hands] [--judge painted|simulation] [--no-store]

45 garments are made by procedure on the open body, on persons of up to three shapes, in the T-pose and, with a scan's
noise and simplified, in an A-pose and with the arms as low as they come before a hand touches the cloth; what is worn
over the arms, with hanging arms (`smplxpp.people.garments`). Their weights are painted by rules in the garments' own
coordinates, none of which is a method compared here; what lies on the skin keeps the weights of the skin that it was
grown from. Weights are transferred from the posed body, the garment is unposed with them and driven to the stress poses
and to worn poses (walking, sitting, reaching); errors are distances in mm to the same garment driven by its authored
weights, the mean of all its scans.

The energy of the published code has a fixed length of 1.4 units: it is run on metres and on centimetres. A ratio is
that of mean errors, ours to the best of nearest point and the published method in both units; 1 where they are less
than 0.2 mm apart.

With `--judge simulation` the truth is nobody's paint: the garments `SIMULATED` are simulated (`smplxpp.cloth`) from the
scan's pose until they hang still, and from there along one path through the worn poses, in each of which they come to
rest. The settled garment is transferred; errors are those of what hangs free, to its places in the simulation. No
weights follow folds, so that "painted", the authored ones, has an error, too; a ratio is as above.

Leave one out: of the settings in `VARIANTS` the best one on all garments of other families (least sum of mean and worst
ratio) is judged on each garment of the family left out; on the first shape in the A-pose.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

from benchmarks.accuracy.driving import Method, nearest_point
from benchmarks.support.people import worn_template
from benchmarks.support.results import store_results
from smplxpp.body import BodyModel, load_body
from smplxpp.body.named_poses import stress_poses, worn_poses
from smplxpp.cloth import ClothDriver, cut_garment
from smplxpp.cloth.driver import DriverConfig
from smplxpp.cloth.poses import pose_between
from smplxpp.core import GeometryWarning, TriangleMesh
from smplxpp.people.garments.wardrobe import POSES, SHAPES, Case, cases
from smplxpp.skinning import UnposeConfig, skin, unpose
from smplxpp.transfer import TransferConfig, transfer_weights
from smplxpp.transfer.checks import extent
from smplxpp.transfer.correspond import closest_points, vertex_components

_TIE_MM = 0.2
_NEAREST, _METRES, _CENTIMETRES, _OURS = "nearest point", "published, m", "published, cm", "ours"
_OTHERS = (_NEAREST, _METRES, _CENTIMETRES)
_DEFAULT = TransferConfig()
_PUBLISHED_LENGTH = 2.0**0.5
"""Length of the published code's energy, `Q = -2 C + 4 C M^-1 C`, in units of the mesh."""
VARIANTS = {
    "default": _DEFAULT,
    "published 0.35": replace(_DEFAULT, published=0.35),
    "published 0.65": replace(_DEFAULT, published=0.65),
    "wide from 0.2": replace(_DEFAULT, hanging=(0.2, 0.3)),
    "wide from 0.3": replace(_DEFAULT, hanging=(0.3, 0.4)),
    "nothing hangs": replace(_DEFAULT, hanging=None),
}
FAMILIES = {
    "trousers": ("trousers", "shorts", "overalls", "jumpsuit", "hakama"),
    "skirts": ("skirt", "tutu", "sari", "apron"),
    "dresses": ("dress",),
    "coats": ("coat", "cape", "poncho", "jacket"),
    "head": ("hood", "scarf", "hair", "bob", "braid", "beard", "hijab"),
    "hands and feet": ("boots", "shoes", "gloves"),
    "things": ("backpack", "plates", "beads"),
}
SIMULATED = (
    "mini skirt",
    "long skirt",
    "flared skirt",
    "full circle skirt",
    "dress",
    "one-shoulder dress",
    "sari",
    "cape",
    "apron",
    "skirt over trousers",
    "hakama",
    "wide trousers, hem 9.5 cm",
    "wide trousers, hem 15 cm",
    "wide trousers, hem 24 cm",
)
_ANY_DETERMINANT = UnposeConfig(warn_below=-np.inf, fail_below=-np.inf)  # baselines may fold a vertex: measure it

Scores = dict[str, dict[str, float]]
Rows = dict[str, list[dict[str, float]]]


@dataclass(frozen=True, eq=False)
class Trial:
    """A case, and what its authored weights make of it.

    Attributes:
        case: the garment as scanned.
        reference: transforms of the joints in the scan's pose.
        driven: those of the stress poses and the worn poses; of a simulation, of the worn poses.
        expected: (P, N, 3) metres, the garment in these poses by its authored weights, or simulated.
        judged: vertices that count: all, or those that hang free in a simulation.
    """

    case: Case
    reference: Float[np.ndarray, "J 4 4"]
    driven: Float[np.ndarray, "P J 4 4"]
    expected: Float[np.ndarray, "P N 3"]
    judged: Bool[np.ndarray, " N"]

    @staticmethod
    def of(body: BodyModel, case: Case) -> Trial:
        """Drive the garment by its authored weights."""
        reference = body.forward(case.params).posed_from_rest[0]
        person = replace(case.params, transl=np.zeros((1, 3)))
        driven = np.concatenate([body.forward(poses(person)).posed_from_rest for poses in (stress_poses, worn_poses)])
        expected = _drive(case.mesh.vertices, case.weights, reference, driven)
        return Trial(case, reference, driven, expected, np.ones(case.mesh.vertex_count, dtype=bool))

    @staticmethod
    def simulated(body: BodyModel, case: Case) -> Trial:
        """Let the garment settle in the scan's pose and move along the worn poses.

        Raises:
            InputError: a garment that nothing carries.
        """
        # The person in the garment as a template, whose rest shape holds the betas. Close layers, as trousers under a
        # skirt, stay as they are skinned, and come first.
        reference = body.forward(case.params).posed_from_rest[0]
        count, person = body.vertex_count, replace(case.params, transl=np.zeros((1, 3)))
        under = _close_layers(case)
        case, under = _ordered(case, np.argsort(~under, kind="stable")), np.sort(under)[::-1]
        template = worn_template(body, case, under=under)
        scanned = person.without_shape()
        garment = cut_garment(template, template.part_names[-1], scanned)
        driver = ClothDriver(template, [garment], DriverConfig(ramp=0.0, hold=0.0))
        worn = worn_poses(scanned)
        path = [scanned, *(worn.frame(k) for k in range(len(worn)))]
        # Settle, then go from pose to pose, each of which is held until the cloth has come to rest; frames of 1/30 s.
        frame, settle, move, hold = 1.0 / 30.0, 60, 30, 36
        shapes = []
        for before, after in pairwise([scanned, *path]):
            for k in range(1, move + 1):
                t = k / move
                driver.step(pose_between(before, after, t * t * (3.0 - 2.0 * t)), frame)
            for _ in range(hold if after is not scanned else settle):
                shape = driver.step(after, frame)
            rest = template.vertices.copy()
            rest[shape.vertices] += shape.displacements
            shapes.append(skin(rest[count:], case.weights, template.posed_from_rest(after)[0]))
        if broken := [note for note in driver.notes if "broke down" in note]:
            warnings.warn(f"{case.garment.name}: {broken[0]}", GeometryWarning, stacklevel=2)
        judged = np.zeros(case.mesh.vertex_count, dtype=bool)
        judged[garment.vertices - count] = garment.share() == 1.0
        settled = replace(case, mesh=case.mesh.with_vertices(shapes[0]))
        return Trial(settled, reference, template.posed_from_rest(worn), np.stack(shapes[1:]), judged)

    def judge(self, dense: Float[np.ndarray, "N J"]) -> dict[str, float]:
        """Mean total variation of the weights; mean, p95 and p99 in mm of all driven positions."""
        error = 1e3 * np.linalg.norm(
            (_drive(self.case.mesh.vertices, dense, self.reference, self.driven) - self.expected)[:, self.judged],
            axis=2,
        )
        p95, p99 = np.percentile(error, [95, 99])
        variation = 0.5 * np.abs(dense - self.case.weights).sum(axis=1).mean()
        return {"tv": float(variation), "mean": float(error.mean()), "p95": float(p95), "p99": float(p99)}


def _close_layers(case: Case) -> np.ndarray:
    """Return the vertices of components close to the skin, where the one that is farthest off is not."""
    component = vertex_components(case.mesh)
    distance = closest_points(case.source, case.mesh).distance
    off = np.array([np.median(distance[component == k]) for k in range(component.max() + 1)])
    close = 0.02  # metres: trousers and bodices are grown 9 to 14 mm off the skin
    return (off < min(close, off.max()))[component]


def _ordered(case: Case, order: np.ndarray) -> Case:
    """Return the case with its vertices in another order."""
    place = np.argsort(order)
    mesh = TriangleMesh(case.mesh.vertices[order], place[case.mesh.faces])
    return replace(case, mesh=mesh, weights=case.weights[order], rest_vertices=case.rest_vertices[order])


def _drive(vertices: np.ndarray, dense: np.ndarray, reference: np.ndarray, driven: np.ndarray) -> np.ndarray:
    rest = unpose(vertices, dense, reference, config=_ANY_DETERMINANT).vertices
    return np.stack([skin(rest, dense, transforms) for transforms in driven])


@dataclass(frozen=True)
class Options:
    """shapes: how many persons. poses: of the scans, T, A or hands. judge: what is true. store: the figures."""

    shapes: int = len(SHAPES)
    poses: tuple[str, ...] = POSES
    judge: Literal["painted", "simulation"] = "painted"
    store: bool = True


def configured(config: TransferConfig, *, by_label: bool = True) -> Method:
    """Our transfer as a method; `by_label` tells it the garment's label."""

    def run(source: TriangleMesh, weights: np.ndarray, target: TriangleMesh, label: str) -> np.ndarray:
        used = TransferConfig.for_label(label, base=config) if by_label else config
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GeometryWarning)
            return transfer_weights(source, weights, target, config=used).dense()

    return run


def published(unit: float) -> Method:
    """Return the published method on meshes in units of so many metres, without labels."""

    def run(source: TriangleMesh, weights: np.ndarray, target: TriangleMesh, label: str) -> np.ndarray:
        config = replace(TransferConfig.paper(), length_scale=_PUBLISHED_LENGTH * unit / extent(source))
        return configured(config, by_label=False)(source, weights, target, label)

    return run


def methods() -> dict[str, Method]:
    """Return the compared methods: the baseline, the published one in both units, and ours."""
    return {
        _NEAREST: nearest_point,
        _METRES: published(1.0),
        _CENTIMETRES: published(0.01),
        "ours, no labels": configured(_DEFAULT, by_label=False),
        _OURS: configured(_DEFAULT),
    }


def measure(body: BodyModel, trials: list[Trial], method: Method) -> Rows:
    """The figures of a method on every scan, by garment, with the CPU seconds it took."""
    found: Rows = {}
    for trial in trials:
        case = trial.case
        begin = time.process_time()
        dense = method(case.source, body.weights, case.mesh, case.garment.label)
        seconds = time.process_time() - begin
        found.setdefault(case.garment.name, []).append({**trial.judge(dense), "seconds": seconds})
    return found


def mean_of(rows: Rows) -> Scores:
    """The mean figures over the scans of each garment."""
    return {name: {key: float(np.mean([row[key] for row in each])) for key in each[0]} for name, each in rows.items()}


def ratio(ours: float, others: float) -> float:
    """Our mean error by another's; 1 where the difference is nothing to see."""
    return 1.0 if abs(ours - others) < _TIE_MM else ours / max(others, _TIE_MM)


def ratios(ours: Scores, others: list[Scores]) -> dict[str, float]:
    """The ratio of every garment to the best of the others."""
    return {name: ratio(row["mean"], min(each[name]["mean"] for each in others)) for name, row in ours.items()}


def best_of(methods: list[Scores]) -> Scores:
    """The figures of the method with the least mean error on each garment."""
    return {name: min((each[name] for each in methods), key=lambda row: row["mean"]) for name in methods[0]}


def summary(ours: Scores, others: Scores) -> dict[str, float]:
    """Mean and worst ratio over the garments, and on how many we are more than 5 % behind."""
    values = list(ratios(ours, [others]).values())
    return {"mean ratio": float(np.mean(values)), "worst ratio": max(values), "behind": sum(v > 1.05 for v in values)}


def family(name: str) -> str:
    """Return the family of a garment: the first whose words its name holds; tops are the rest."""
    return next((key for key, words in FAMILIES.items() if any(word in name for word in words)), "tops")


def leave_one_out(variants: dict[str, dict[str, float]]) -> dict[str, dict[str, object]]:
    """Return for each garment the variant that is best on all other families, and its ratio on this one."""
    names = list(next(iter(variants.values())))
    out: dict[str, dict[str, object]] = {}
    for left in names:

        def cost(variant: str, left: str = left) -> float:
            others = [value for name, value in variants[variant].items() if family(name) != family(left)]
            return float(np.mean(others)) + max(others)

        best = min(variants, key=cost)
        out[left] = {"family": family(left), "chosen on the others": best, "ratio here": variants[best][left]}
    return out


def main(options: Options) -> None:
    console, body = Console(width=150), load_body()
    worn = [case for shape in SHAPES[: options.shapes] for case in cases(body, shape, poses=options.poses)]
    if options.judge == "painted":
        trials = [Trial.of(body, case) for case in worn]
    else:
        trials = [Trial.simulated(body, case) for case in worn if case.garment.name in SIMULATED]
    rows = {name: measure(body, trials, method) for name, method in methods().items()}
    scores = {name: mean_of(each) for name, each in rows.items()}
    others = [scores[name] for name in _OTHERS]
    compared = ratios(scores[_OURS], others)
    drawn = scores
    if options.judge == "simulation":
        painted: Rows = {}
        for trial in trials:
            painted.setdefault(trial.case.garment.name, []).append(trial.judge(trial.case.weights))
        drawn = {"painted": mean_of(painted), **scores}
    figures: dict[str, object] = {
        "driven, mm": {
            name: {method: {k: each[name][k] for k in ("mean", "p95", "p99")} for method, each in drawn.items()}
            | {"ratio": value}
            for name, value in compared.items()
        },
        "weights, total variation": {
            name: {method: each[name]["tv"] for method, each in scores.items()} for name in compared
        },
        "summary": {
            name: summary(scores[_OURS], each)
            for name, each in {
                **{name: scores[name] for name in _OTHERS},
                "best of the others": best_of(others),
            }.items()
        },
        "CPU seconds a scan": {
            method: float(np.mean([row["seconds"] for row in each.values()])) for method, each in scores.items()
        },
    }
    if options.judge == "painted":
        garments = {trial.case.garment.name: trial.case.garment for trial in trials}
        figures |= _variants(body, trials, others, compared) | {
            "garments": {
                name: {"label": garment.label, "authored weights": garment.rule} for name, garment in garments.items()
            }
        }
    _print(console, drawn, compared)
    if options.store:
        simulated = options.judge == "simulation"
        command = f"python -m benchmarks transfer_garments --shapes {options.shapes} --poses {' '.join(options.poses)}"
        command += " --judge simulation" if simulated else ""
        name = "transfer_garments_simulated" if simulated else "transfer_garments"
        console.print(f"stored in {store_results(name, command, figures)}")


def _variants(
    body: BodyModel, trials: list[Trial], others: list[Scores], compared: dict[str, float]
) -> dict[str, object]:
    """Return the figures of `VARIANTS`, tried on the first shape's A-pose, against the others on the same trials."""
    first = [trial for trial in trials if trial.case.shape == SHAPES[0] and trial.case.pose in ("A", "down")]
    same = len(first) == len(trials)
    there = others if same else [mean_of(measure(body, first, methods()[name])) for name in _OTHERS]
    tried = {name: config for name, config in VARIANTS.items() if not (same and config == _DEFAULT)}
    variants = {
        name: ratios(mean_of(measure(body, first, configured(config))), there) for name, config in tried.items()
    }
    if same:
        variants = {"default": compared, **variants}
    return {
        "leave one family out": leave_one_out(variants),
        "variants: mean and worst ratio": {
            name: {"mean": float(np.mean(list(row.values()))), "worst": max(row.values())}
            for name, row in variants.items()
        },
    }


def _print(console: Console, scores: dict[str, Scores], compared: dict[str, float]) -> None:
    table = Table(title="driven error, mean / p99 mm")
    for column in ("garment", *scores, "ratio"):
        table.add_column(column, no_wrap=True)
    for name, value in compared.items():
        cells = [f"{rows[name]['mean']:.2f} / {rows[name]['p99']:.0f}" for rows in scores.values()]
        table.add_row(name, *cells, f"{value:.2f}")
    console.print(table)


if __name__ == "__main__":
    main(tyro.cli(Options))
