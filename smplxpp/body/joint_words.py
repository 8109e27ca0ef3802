"""Read the names that programs give to the joints of a person: side, part of the body, finger and bone."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Side = Literal["left", "right"]
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
_SIDES: dict[str, Side] = {"left": "left", "l": "left", "lft": "left", "左": "left"}
_SIDES |= {"right": "right", "r": "right", "rgt": "right", "右": "right"}
# Words that are no joint of the body, as whole words of a name, and anywhere in it.
_OTHER_WORDS = frozenset(
    "ik pole nub end tip site target effector helper dummy goal socket prop gun ear lip chin".split()
)
_OTHER = (
    "twist roll helper hair skirt cape wing weapon breast eye jaw brow tongue nose mouth teeth cheek lash 捩".split()
)
# Words of limbs, in the order in which they are looked for: "forefoot" is no foot. The first that a name has is taken.
_LIMBS = {
    "toe": "toe ball forefoot metatars つま先",
    "ankle": "ankle talus 足首",
    "foot": "foot calcn heel",
    "shin": "lowerleg lowleg legupto knee shin calf shank tibia ひざ",
    "thigh": "upperleg upleg uleg thigh femur 足",
    "leg": "leg",
    "seat": "hipjoint buttock",
    "hip": "hip",
    "forearm": "forearm lowerarm lowarm farm larm elbow radius ulna ひじ",
    "upperarm": "upperarm uparm uarm shldr humerus bicep",
    "wrist": "wrist carpus 手首",
    "hand": "hand palm",
    "collar": "collar clav scapula",
    "shoulder": "shoulder 肩",
    "arm": "arm 腕",
}
_MIDDLE = {
    "neck": "neck 首",
    "head": "head skull 頭",
    "pelvis": "pelvis hips hip 下半身",
    "spine": "spine back abdomen chest torso waist thorax lumbar rib belly 上半身",
}
_FINGER_WORDS = {"middle": "middle mid", "pinky": "pinky little", "thumb": "thumb", "index": "index", "ring": "ring"}
# Bones of a finger by their names; 0 lies in the hand.
_BONES = {"metacarpal": 0, "inhand": 0, "root": 0, "proximal": 1, "base": 1, "intermediate": 2, "distal": 3}


@dataclass(frozen=True)
class JointWords:
    """What a name says.

    Attributes:
        side: of the body; None: in the middle, or not stated.
        part: word of a limb or of the trunk; "finger", "other" (eyes, twists, ends), or "" for an unknown name.
        finger: of `FINGERS`, or the number of an unnamed finger as text.
        bone: number of the finger's bone from the hand, 0 in the hand; None if not stated.
    """

    side: Side | None = None
    part: str = ""
    finger: str = ""
    bone: int | None = None


def read_name(name: str) -> JointWords:
    """Read the name of a joint, without name space, in any usual spelling.

    Example:
        >>> read_name("mixamorig:LeftUpLeg").part, read_name("J_Bip_R_UpperLeg").part, read_name("lShin").side
        ('thigh', 'thigh', 'left')
        >>> read_name("LeftHandIndex2")
        JointWords(side='left', part='finger', finger='index', bone=2)
    """
    words = _words(re.sub(r"^.*[:|]", "", name))
    side = next((_SIDES[word] for word in words if word in _SIDES), None)
    letters = [word for word in words if word not in _SIDES and not word.isdigit()]
    plain = "".join(letters)
    if side is None:
        side, plain = _glued_side(plain)
    # Fingers first: their names have the hand's, and bones that are called tips.
    if side is not None and (found := _finger(name.lower(), plain, letters)):
        return JointWords(side, "finger", *found)
    if _OTHER_WORDS & set(letters) or any(word in plain for word in _OTHER):
        return JointWords(side, "other")
    if side is None:
        return JointWords(None, _first(_MIDDLE, plain))
    # "arm lower", "leg upper": the words in any order.
    for limb, parts in (("arm", ("forearm", "upperarm")), ("leg", ("shin", "thigh"))):
        if limb in plain and ("low" in plain or "up" in plain):
            return JointWords(side, parts[0 if "low" in plain else 1])
    return JointWords(side, _first(_LIMBS, plain))


def _words(name: str) -> list[str]:
    """Split a name at blanks, signs, digits and capitals, in lower case."""
    found = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+|[左右]|[^\W\d_a-zA-Z左右]+", name)
    return [word.lower() for word in found]


def _glued_side(plain: str) -> tuple[Side | None, str]:
    """Return the side of a name in which no capital or sign sets it off ("lefthip", "rcollar"), and the rest."""
    for word, side in _SIDES.items():
        for rest in (plain.removeprefix(word), plain.removesuffix(word)):
            # A single letter is only a side before the name of a limb: "rib" and "leg" have none.
            known = len(word) > 1 or any(rest == one for words in _LIMBS.values() for one in words.split())
            if rest and rest != plain and (known or rest in _FINGER_WORDS):
                return side, rest
    return None, plain


def _first(table: dict[str, str], plain: str) -> str:
    return next((part for part, words in table.items() if any(word in plain for word in words.split())), "")


def _finger(name: str, plain: str, letters: list[str]) -> tuple[str, int | None] | None:
    """Return the finger and the bone of a name, None for other joints."""
    kinds = [kind for kind, words in _FINGER_WORDS.items() if any(_has(plain, letters, word) for word in words.split())]
    # "index mid" is a bone of the index finger.
    kinds = [kind for kind in kinds if kind != "middle" or "middle" in plain] or kinds
    if "toe" in plain or not (kinds or "finger" in plain or "metacarpal" in plain):
        return None
    # Numbers behind the finger's word: those before belong to the skeleton ("Bip01").
    at = max(name.find(word) for word in ("finger", "metacarpal", *(_FINGER_WORDS[kinds[0]].split() if kinds else ())))
    numbers = re.findall(r"[0-9]+", name[at:])
    finger = kinds[0] if kinds else ""
    if not finger and numbers:
        # Biped: Finger01 is the second bone of finger 0.
        digits = numbers.pop(0)
        finger, numbers = digits[0], [str(int(digits[1:]) + 1)] if len(digits) > 1 else numbers
    # After every bone.
    end = 9
    if {"end", "nub"} & set(letters):
        return finger, end
    bone = next((number for word, number in _BONES.items() if word in plain), None)
    if bone is None and finger != "middle" and "mid" in letters:
        bone = 2
    if bone is None and "tip" in letters:
        bone = 3
    if bone is None and numbers:
        bone = int(numbers[0][-2:])
    return finger, bone


def _has(plain: str, letters: list[str], word: str) -> bool:
    return word in letters if len(word) < 5 else word in plain
