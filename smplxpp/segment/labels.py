"""Find label sets by name or file, and map the ids of their files onto our labels."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int64, Num

from smplxpp.core import LABELS, InputError
from smplxpp.core.errors import did_you_mean
from smplxpp.core.files.json_file import as_object, read_json
from smplxpp.core.files.markup_file import read_yaml
from smplxpp.segment.label_sets import LABEL_SETS, LabelSet, label_set_of


def find_label_set(name: str | Path | LabelSet) -> LabelSet:
    """Return a label set by its name, or from a file.

    A file is YAML or JSON: a set of one's own, `{"classes": [...]}` (docs/labels.md), or as JSON a mapping
    `{"<their id>": "<our name>", ...}` to skin, hair, shoe, upper, lower, outer, object and background.

    Raises:
        InputError: an unknown name, or a file that is neither.
    """
    if isinstance(name, LabelSet):
        return name
    if str(name) in LABEL_SETS:
        return LABEL_SETS[str(name)]
    path = Path(name)
    suffix = path.suffix.lower()
    if suffix not in (".json", ".yaml", ".yml") or not path.is_file():
        raise InputError(
            "label set",
            expected=f"one of {', '.join(LABEL_SETS)}, or an existing YAML or JSON file",
            received=repr(str(name)),
            remedy=did_you_mean(name, LABEL_SETS),
        )
    subject = f"label set {path}"
    content = read_json(path, subject="label set") if suffix == ".json" else read_yaml(path, subject="label set")
    if suffix != ".json" or (isinstance(content, dict) and "classes" in content):
        return label_set_of(as_object(content, subject=subject), subject=subject, name=path.stem)
    ours = (*LABELS.names, "background")
    expected = f"a mapping of integers to names among {', '.join(ours)}"
    try:
        classes = tuple(sorted((int(number), str(ours), ours) for number, ours in content.items()))
    except (ValueError, AttributeError) as error:
        raise InputError(subject, expected=expected, received=str(error)) from None
    unknown = sorted({str(name) for _, _, name in classes if not isinstance(name, str) or name not in ours})
    if unknown or not classes:
        raise InputError(subject, expected=expected, received=f"{', '.join(unknown) or 'nothing'}")
    return LabelSet(path.stem, classes)


def map_labels(
    ids: Num[np.ndarray, "*N"], label_set: str | Path | LabelSet | Mapping[int, int]
) -> Int64[np.ndarray, "*N"]:
    """Map ids of a label set, in an array of any shape, to ours (int64, background -1).

    Args:
        ids: integers; floats that hold integers are accepted.
        label_set: see `find_label_set`; or a mapping from their ids to ours.

    Raises:
        InputError: ids that the set does not have; it names the sets that have all of them.
    """
    name = "mapping" if isinstance(label_set, Mapping) else find_label_set(label_set).name
    mapping = label_set if isinstance(label_set, Mapping) else find_label_set(label_set).ours
    ids = np.asarray(ids)
    whole = ids.dtype.kind == "f" and np.array_equal(ids, np.rint(ids)) and (np.abs(ids) < 2**53).all()
    if ids.dtype.kind not in "iub" and not whole:
        raise InputError("label ids", expected="integers", received=str(ids.dtype))
    # Images hold bytes, of which a table is quicker than a sort.
    of_image = ids.dtype == np.uint8
    if of_image:
        unique = np.flatnonzero(np.bincount(ids.ravel(), minlength=256))
    else:
        unique, inverse = np.unique(ids.astype(np.int64), return_inverse=True)
    unknown = [int(u) for u in unique if int(u) not in mapping]
    if unknown:
        fitting = [one.name for one in LABEL_SETS.values() if set(unique.tolist()) <= set(one.ours)]
        raise InputError(
            f"label ids of set {name!r}",
            expected=f"ids among {sorted(mapping)}",
            received=f"{unknown[:10]}{' ...' if len(unknown) > 10 else ''}",
            remedy=f"{' and '.join(fitting) or 'no built-in set'} {'have' if len(fitting) > 1 else 'has'} all ids of "
            "this file: name its label set with --label-set, or describe it in a labels.yaml",
        )
    ours = np.array([mapping[int(u)] for u in unique], dtype=np.int64)
    if not of_image:
        return ours[inverse].reshape(ids.shape)
    table = np.zeros(256, dtype=np.int64)
    table[unique] = ours
    return table[ids]
