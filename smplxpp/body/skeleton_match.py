"""Find the joints of a person in another program's skeleton: who hangs on whom first, names as evidence.

Legs and arms are chains that end in joints named as feet and hands or, where names say nothing, the two pairs of equal
branches of the tree. The pelvis is where the legs meet, the chest is where the arms meet. Within a chain the joints are
chosen that score best by their names and by the lengths of the bones between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.body.joint_words import FINGERS, JointWords, Side, read_name

SIDES: tuple[Side, Side] = ("left", "right")
LEG, ARM = ("hip", "knee", "ankle", "foot"), ("collar", "shoulder", "elbow", "wrist")
# How well a word fits a joint. Words that two joints share ("leg", "hip", "foot", "shoulder") weigh less.
_WEIGHTS: dict[str, dict[str, float]] = {
    "hip": {"thigh": 3.0, "hip": 2.0, "leg": 1.0, "seat": 0.5},
    "knee": {"shin": 3.0, "leg": 2.0},
    "ankle": {"ankle": 3.0, "foot": 2.5},
    "foot": {"toe": 3.0, "foot": 1.5},
    "collar": {"collar": 3.0, "shoulder": 2.0},
    "shoulder": {"upperarm": 3.0, "arm": 2.5, "shoulder": 2.0},
    "elbow": {"forearm": 3.0, "arm": 0.5},
    "wrist": {"wrist": 3.0, "hand": 2.5},
}
_LEG_WORDS = frozenset(word for part in LEG for word in _WEIGHTS[part])
_ARM_WORDS = frozenset(word for part in ARM for word in _WEIGHTS[part])
# Weight of equal bones above and below the knee or elbow, and of bones that fill the chain: less than one word's.
_EQUAL, _LONG = 2.0, 1.5
_PAIR = 0.85  # least ratio of the lengths of two branches that are a pair of legs or arms


@dataclass(frozen=True, eq=False)
class Tree:
    """A skeleton's names, parents (-1: root), places at rest, and what its names say."""

    names: tuple[str, ...]
    parents: Int64[np.ndarray, " J"]
    places: Float64[np.ndarray, "J 3"]

    @property
    def words(self) -> list[JointWords]:
        """What each name says."""
        return [read_name(name) for name in self.names]

    def above(self, joint: int) -> list[int]:
        """Return a joint and all above it, up to the root."""
        found = []
        while joint >= 0:
            found.append(joint)
            joint = int(self.parents[joint])
        return found

    def meet(self, a: int, b: int) -> int:
        """Return the lowest joint that both joints hang on; -1 without one."""
        line = self.above(b)
        return next((joint for joint in self.above(a) if joint in line), -1)

    def below(self, begin: int, end: int) -> list[int]:
        """Return the joints from `begin`, which is left out, down to `end`; empty if `end` does not hang on it."""
        line = self.above(end)
        return line[: line.index(begin)][::-1] if begin in line else []

    def length(self, joints: Sequence[int]) -> float:
        """Return the length of the bones along a path."""
        return float(np.linalg.norm(np.diff(self.places[list(joints)], axis=0), axis=1).sum())


def match_joints(
    names: Sequence[str], parents: Int64[np.ndarray, " J"], places: Float64[np.ndarray, "J 3"]
) -> dict[str, int]:
    """Return the index of the skeleton's joint for each of SMPL-X's joints that it has.

    Args:
        names: of the J joints.
        parents: index of each joint's parent, -1 for a root.
        places: at rest, in any unit.

    Returns:
        By SMPL-X's names; without those that are not there, and without the joints of the spine (`spine_of`), because
        skeletons have one to six of them at other heights, so that none stands for one of ours.

    Example:
        >>> names = ["Root", "L_Thigh", "L_Shin", "L_Foot", "R_Thigh", "R_Shin", "R_Foot", "Chest"]
        >>> names += ["L_Arm", "L_Elbow", "L_Hand", "R_Arm", "R_Elbow", "R_Hand"]
        >>> parents = np.array([-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 9, 7, 11, 12])
        >>> x = np.array([0, 1, 1, 1, -1, -1, -1, 0, 2, 5, 8, -2, -5, -8])
        >>> y = np.array([0, 0, -4, -8, 0, -4, -8, 4, 4, 4, 4, 4, 4, 4])
        >>> found = match_joints(names, parents, np.stack([x, y, 0 * x], axis=1).astype(float))
        >>> names[found["pelvis"]], names[found["left_hip"]], names[found["right_wrist"]]
        ('Root', 'L_Thigh', 'R_Hand')
    """
    tree = Tree(tuple(names), np.asarray(parents), np.asarray(places, np.float64))
    words = tree.words
    legs, arms = (_named_ends(tree, words, limb) for limb in (_LEG_WORDS, _ARM_WORDS))
    if legs is None or arms is None:
        legs, arms = _ends_by_shape(tree)
    if legs is None or arms is None:
        return {}
    pelvis, chest = tree.meet(*legs), tree.meet(*arms)
    found: dict[str, int] = {}
    for side, leg, arm in zip(SIDES, legs, arms, strict=True):
        found |= _limb(tree, words, tree.below(pelvis, leg), side, LEG, {"foot"})
        found |= _limb(tree, words, tree.below(chest, arm), side, ARM, {"collar", "wrist"})
    if not all(f"{side}_{part}" in found for side in SIDES for part in ("hip", "shoulder")):
        return found
    found["pelvis"] = _pelvis(tree, words, pelvis, found)
    found |= _neck_and_head(tree, words, chest, set(tree.above(legs[0]) + tree.above(legs[1])) | set(arms))
    return found | _fingers(tree, words, found)


def spine_of(tree: Tree, found: Mapping[str, int]) -> list[int]:
    """Return the joints between the pelvis and the neck or, without a neck, up to the joint that the arms hang on."""
    chest = tree.meet(found["left_shoulder"], found["right_shoulder"])
    top = int(tree.parents[found["neck"]]) if "neck" in found else chest
    # Where the trunk does not hang on the pelvis, both hang on a joint above, and the path leads over it.
    meet = tree.meet(found["pelvis"], top)
    return [joint for joint in tree.below(meet, top) if joint != found["pelvis"]]


def _named_ends(tree: Tree, words: list[JointWords], limb: frozenset[str]) -> tuple[int, int] | None:
    """Return the lowest joints of the left and the right limb by their names; None if a side has no chain of them."""
    ends = []
    for side in SIDES:
        own = {joint for joint, word in enumerate(words) if word.side == side and word.part in limb}
        # The joint below most others of the limb; joints that only share its name (targets of solvers) have few.
        depth = {joint: len(own.intersection(tree.above(joint))) for joint in own}
        if not depth or max(depth.values()) < 2:
            return None
        ends.append(max(depth, key=lambda joint: (depth[joint], -joint)))
    return ends[0], ends[1]


def _ends_by_shape(tree: Tree) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """Return the ends of legs and arms of a skeleton whose names say nothing, each left before right.

    Legs are two branches of equal length of one joint, arms are two of another that hangs below it, beside a third.
    """
    count = len(tree.names)
    bone = np.zeros(count)
    has = tree.parents >= 0
    bone[has] = np.linalg.norm(tree.places[has] - tree.places[tree.parents[has]], axis=1)
    # Reach: the length of the longest path below a joint, and the joint at its end.
    reach, end = np.zeros(count), np.arange(count)
    for joint in range(count - 1, 0, -1):
        above = tree.parents[joint]
        if above >= 0 and reach[joint] + bone[joint] >= reach[above]:
            reach[above], end[above] = reach[joint] + bone[joint], end[joint]
    pairs = []
    # Of the longest path: shorter branches (fingers, toes, faces) are no limbs.
    branch = 0.15
    for joint in range(count):
        own = [k for k in np.flatnonzero(tree.parents == joint) if reach[k] + bone[k] > branch * reach.max()]
        length = {int(k): float(reach[k] + bone[k]) for k in own}
        fitting = [
            (min(length[a], length[b]) / max(length[a], length[b]), a, b)
            for a, b in combinations(length, 2)
            if min(length[a], length[b]) > _PAIR * max(length[a], length[b])
        ]
        if fitting and len(length) > 2:
            pairs.append((joint, *max(fitting)[1:]))
    if len(pairs) < 2:
        return None, None
    (hips, *legs), (_, *arms) = pairs[0], pairs[-1]
    # Left is where the feet's direction and the vertical put it; without toes, the skeleton looks along +z or, with z
    # up, along -y, as files without names do.
    up = tree.places[pairs[-1][0]] - tree.places[hips]
    front = _toes(tree, [int(end[joint]) for joint in legs], up)
    if front is None:
        front = np.array([0.0, 0.0, 1.0] if np.argmax(np.abs(up)) == 1 else [0.0, -1.0, 0.0])
    left = np.cross(up, front)
    ordered = []
    for pair in (legs, arms):
        ends = [int(end[joint]) for joint in pair]
        ends.sort(key=lambda joint: -float(tree.places[joint] @ left))
        ordered.append((ends[0], ends[1]))
    return ordered[0], ordered[1]


def _toes(tree: Tree, ends: list[int], up: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"] | None:
    """Return the direction of the last bones of both legs across the vertical; None where they lie along it."""
    across = np.zeros(3)
    for joint in ends:
        bone = tree.places[joint] - tree.places[tree.parents[joint]]
        bone = bone / max(float(np.linalg.norm(bone)), 1e-12)
        across += bone - up * float(bone @ up) / max(float(up @ up), 1e-12)
    return across if float(np.linalg.norm(across)) > 1.0 else None


def _limb(
    tree: Tree, words: list[JointWords], chain: list[int], side: Side, parts: Sequence[str], optional: set[str]
) -> dict[str, int]:
    """Choose the joints of a limb from its chain: highest sum of words' weights and of the bones' shape.

    Args:
        chain: joints from the trunk on.
        parts: the joints along the limb, of which the `optional` ones may be missing.
    """
    # Joints of a chain that are tried: four of 14 are 1001 choices.
    longest_chain = 14
    chain = chain[:longest_chain]
    choices = [[f"{side}_{part}" for part in parts if part not in gone] for gone in _subsets(optional)]
    best: tuple[float, dict[str, int]] = (-np.inf, {})
    for chosen in choices:
        for joints in combinations(chain, len(chosen)):
            score = _score(tree, words, chain, dict(zip(chosen, joints, strict=True)))
            # Of joints at one place the upper one is taken, whatever the rounding.
            if score > best[0] + 1e-6:
                best = score, dict(zip(chosen, joints, strict=True))
    return best[1]


def _subsets(names: set[str]) -> list[set[str]]:
    return [set(some) for count in range(len(names) + 1) for some in combinations(sorted(names), count)]


def _score(tree: Tree, words: list[JointWords], chain: list[int], chosen: dict[str, int]) -> float:
    """Return how well joints of a chain fit the parts of a limb."""
    total = 0.0
    for name, joint in chosen.items():
        part = words[joint].part
        weight = _WEIGHTS[name.split("_")[1]]
        # A word of another part speaks against a joint; eyes, twists and fingers are no limb's.
        known = -4.0 if part in ("other", "finger") else -1.0
        total += weight.get(part, known if part else 0.0)
    place = {name.split("_")[1]: joint for name, joint in chosen.items()}
    upper, middle, lower = ("hip", "knee", "ankle") if "knee" in place else ("shoulder", "elbow", "wrist")
    if middle not in place or lower not in place or upper not in place:
        return total - _EQUAL
    first = tree.length([place[upper], *tree.below(place[upper], place[middle])])
    second = tree.length([place[middle], *tree.below(place[middle], place[lower])])
    whole = max(tree.length(chain), 1e-12)
    total += _EQUAL * min(first, second) / max(first, second, 1e-12) + _LONG * (first + second) / whole
    # A collar is shorter than an arm, a foot than a shin.
    collar = tree.length([place["collar"], *tree.below(place["collar"], place[upper])]) if "collar" in place else 0.0
    foot = tree.length([place[lower], *tree.below(place[lower], place["foot"])]) if "foot" in place else 0.0
    return total - (collar > first) - (foot > second)


def _pelvis(tree: Tree, words: list[JointWords], meet: int, found: Mapping[str, int]) -> int:
    """Return the joint that is the pelvis: where the legs meet, unless another one of that name is nearer the hips."""
    middle = 0.5 * (tree.places[found["left_hip"]] + tree.places[found["right_hip"]])
    leg = tree.length([found["left_hip"], *tree.below(found["left_hip"], found["left_ankle"])])
    distance = np.linalg.norm(tree.places - middle, axis=1)
    named = [joint for joint, word in enumerate(words) if word.part == "pelvis" and word.side is None]
    # Of a leg: farthest pelvis from the middle between the hips.
    far = 0.5
    if distance[meet] > far * leg and named:
        return min(named, key=lambda joint: float(distance[joint]))
    return meet


def _neck_and_head(tree: Tree, words: list[JointWords], chest: int, limbs: set[int]) -> dict[str, int]:
    """Return the neck and the head: on the path from the chest to the joint that is named the head, or to the top."""
    under = [joint for joint in range(len(tree.names)) if chest in tree.above(joint) and joint != chest]
    heads = [joint for joint in under if words[joint].part == "head"]
    necks = [joint for joint in under if words[joint].part == "neck"]
    if heads or necks:
        head = min(heads, key=lambda joint: len(tree.above(joint))) if heads else None
        path = tree.below(chest, necks[0] if head is None else head)
        # A chest that is called neck carries the shoulders, too.
        neck = next((joint for joint in path if words[joint].part == "neck"), None)
        if neck is None and words[chest].part == "neck":
            neck = chest
        if neck is None and head is not None and len(path) > 1:
            neck = path[-2]
    else:
        # Without names: the branch of the chest that holds neither arm.
        free = [joint for joint in under if not any(joint in tree.above(end) for end in limbs)]
        free = [joint for joint in free if not words[joint].side and words[joint].part != "other"]
        first = [joint for joint in free if tree.parents[joint] == chest]
        if not first:
            return {}
        neck = max(
            first, key=lambda joint: max(tree.length(tree.below(chest, k)) for k in free if joint in tree.above(k))
        )
        child = np.flatnonzero(tree.parents == neck)
        head = int(child[0]) if len(child) else None
    return {name: joint for name, joint in (("neck", neck), ("head", head)) if joint is not None}


def _fingers(tree: Tree, words: list[JointWords], found: Mapping[str, int]) -> dict[str, int]:
    """Return the three bones of each finger, by the fingers' names or their numbers from the thumb on."""
    out: dict[str, int] = {}
    # Joints of fingers that make a hand; fewer are markers.
    hand = 4
    for side in SIDES:
        own = [joint for joint, word in enumerate(words) if word.part == "finger" and word.side == side]
        if len(own) < hand:
            continue
        first = 0 if any(words[joint].finger == "0" for joint in own) else 1
        chains: dict[str, list[int]] = {}
        for joint in own:
            finger = words[joint].finger
            number = int(finger) - first if finger.isdigit() else -1
            finger = FINGERS[number] if 0 <= number < len(FINGERS) else finger
            if finger in FINGERS and words[joint].bone != 9:
                chains.setdefault(finger, []).append(joint)
        for finger, joints in chains.items():
            joints.sort(key=lambda joint: len(tree.above(joint)))
            # Bones within the hand are left out where three others are there (a thumb's first one lies in it).
            outer = [joint for joint in joints if words[joint].bone != 0]
            bones = outer if len(outer) >= 3 or len(outer) == len(joints) else joints
            out |= {f"{side}_{finger}{k + 1}": joint for k, joint in enumerate(bones[:3])}
    return out
