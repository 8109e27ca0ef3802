"""Label sets of one's own: what a labels.yaml may say, and how it meets the numbers of parsers."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.core import BACKGROUND, LABELS, InputError, Labels
from smplxpp.core.files.markup_file import read_yaml
from smplxpp.segment import LabelSet, SegmentedScan, find_label_set, map_labels, segment_scan
from tests.segment.views import sphere


def test_classes_take_the_numbers_of_a_parser_by_name():
    dress = {"name": "dress", "ids": ["dress", "jumpsuits"]}
    rows = [{"name": "hat"}, {"name": "coat"}, dress, {"name": "sunglasses"}]
    mine = LabelSet.of({"files": "lip", "classes": rows})
    names = {
        number: "background" if ours == BACKGROUND else mine.labels[ours].name for number, ours in mine.ours.items()
    }
    assert [names[k] for k in (0, 1, 2, 4, 5, 6, 7, 10, 9, 255)] == [
        *("background", "hat", "hair", "sunglasses", "upper", "dress", "coat", "dress", "lower", "background"),
    ]
    socks = LabelSet.of({"files": "sapiens", "classes": [{"name": "sock", "layer": 0.5}]})
    assert [k for k, ours in socks.ours.items() if ours == 7] == [9, 18]
    assert socks.labels.layer_order == (7, 2, 4, 3, 5, 1)
    np.testing.assert_array_equal(mine.labels.kind_ids(np.array([7, 8, 9, 10, -1])), [1, 5, 3, 6, -1])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"classes": [{"name": "hat", "rul": "x"}]}, "Did you mean 'rule'"),
        ({"classes": [{"name": "obi"}]}, "kind"),
        ({"classes": [{"name": "obi", "kind": "uper"}]}, "Did you mean 'upper'"),
        ({"classes": [{"name": "obi", "kind": "upper", "rule": "rigid"}]}, "rigid:JOINT"),
        ({"classes": [{"name": "a/b", "kind": "upper"}]}, "letters"),
        ({"classes": [{"name": "bag", "layer": 2}]}, "layer"),
        ({"classes": [{"name": "hat", "ids": 3}, {"name": "bag", "ids": 3}]}, "each id once"),
        ({"classes": [{"name": "hat", "color": [255, 128, 1]}]}, "told apart"),
        ({"classes": [{"name": "skin", "kind": "hair"}]}, "built in"),
        ({"files": "lipp", "classes": [{"name": "hat"}]}, "Did you mean 'lip'"),
        ({"files": "lip", "classes": [{"name": "hat", "ids": "hatt"}]}, "Did you mean 'hat'"),
        ({"classes": []}, "at least one"),
    ],
)
def test_a_wrong_entry_is_named(content, said):
    with pytest.raises(InputError, match=said):
        LabelSet.of(content)


def test_unknown_ids_come_with_the_sets_that_have_them():
    with pytest.raises(InputError, match=r"received \[17\]\. Lip and cihp and atr and sapiens have"):
        map_labels(np.array([0, 17], np.uint8), "capture")


def test_labels_survive_their_file_and_the_default_stays_itself():
    mine = LabelSet.of({"classes": [{"name": "scarf", "layer": 4.5, "fit": "tight"}]}).labels
    assert Labels.from_list(mine.as_list()) == mine != LABELS
    assert LabelSet.of({"classes": [{"name": "upper", "ids": 3}]}).labels == LABELS


def test_what_body_and_colours_call_upper_is_the_dress_where_files_have_no_upper():
    mine = LabelSet.of({"classes": [{"name": "dress", "ids": 1}, {"name": "hair", "ids": 2}]})
    np.testing.assert_array_equal(mine.of_body(np.array([0, 1, 3, 4, -1])), [0, 1, 7, 4, -1])


def test_glasses_are_no_island():
    """Two patches of less than 0.3 % of the surface: a thing of one's own stays, a speck of cloth is absorbed."""
    ball = sphere()
    mine = LabelSet.of({"classes": [{"name": "glasses", "ids": 1, "rule": "rigid:head"}]}).labels
    faces = np.zeros(ball.face_count, dtype=np.int64)
    near = np.argsort(np.linalg.norm(ball.face_centers - [0, 0, 1], axis=1))[:12]
    far = np.argsort(np.linalg.norm(ball.face_centers - [1, 0, 0], axis=1))[:12]
    assert ball.face_areas[near].sum() < 0.003 * ball.face_areas.sum()
    faces[near], faces[far] = 7, 3
    found = segment_scan(ball, face_labels=faces, labels=mine)
    assert isinstance(found, SegmentedScan) and set(found.face_labels[near]) == {7} and set(found.face_labels) == {0, 7}


YAML = """# a set
name: my set
files: lip   # numbers
classes:
  - name: dress
    ids: [dress, "jump # suits",
      7]
    fit: true
  - {name: 'it''s', rule: rigid:head, layer: -1.5e0}
  -
    name: hat
    ids:
    - 1
    - ~
empty:
"""


def test_yaml_by_hand(tmp_path):
    path = tmp_path / "labels.yaml"
    path.write_text(YAML)
    assert read_yaml(path) == {
        "name": "my set",
        "files": "lip",
        "classes": [
            {"name": "dress", "ids": ["dress", "jump # suits", 7], "fit": True},
            {"name": "it's", "rule": "rigid:head", "layer": -1.5},
            {"name": "hat", "ids": [1, None]},
        ],
        "empty": None,
    }


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: &x 1", "line 1.*anchor"),
        ("a: *x", "an alias"),
        ("a: !!python/object/apply:os.system [ls]", "a tag"),
        ("a: |\n  b", "several lines"),
        ("a: 1\na: 2", "line 2.*one entry 'a'"),
        ("a: 1\n   b: 2", "line 2"),
        ("a: [1, 2", "closed"),
        ("a: 'b", "quotes"),
        ("a: b: c", "one key a line"),
        ("a: 1\n---\nb: 2", "one document"),
        ("- " * 40 + "a", "levels"),
        ("a: " + "[" * 40, "levels"),
        ("\ta: 1", "spaces"),
    ],
)
def test_yaml_beyond_what_people_write_is_refused_by_its_line(tmp_path, text, said):
    path = tmp_path / "labels.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        find_label_set(path)
