from __future__ import annotations

import numpy as np

from smplxpp.core.labels import BACKGROUND, CLOTH_LABELS, LABELS, display_colors, semantic_colors


def test_ids_are_positions_so_that_tables_can_be_indexed():
    assert [label.id for label in LABELS] == list(range(len(LABELS)))


def test_display_colours_tell_labels_apart():
    colors = display_colors(np.arange(len(LABELS)))
    assert len(np.unique(colors, axis=0)) == len(LABELS)


def test_semantic_colours_follow_the_paper():
    colors = semantic_colors(np.array([label.id for label in CLOTH_LABELS]))
    assert (colors == (255, 0, 0)).all()
    np.testing.assert_array_equal(semantic_colors(np.array([1])), [(255, 255, 0)])


def test_background_is_black():
    np.testing.assert_array_equal(display_colors(np.array([BACKGROUND])), [(0, 0, 0)])
