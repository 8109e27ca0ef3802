"""Which pictures an evaluation keeps."""

from __future__ import annotations

import numpy as np

from avatar.evaluation.protocol import Gallery, ShownView, ViewSet

PSNR = {0: 20.0, 1: 15.0, 2: 18.0, 3: 15.0, 4: 30.0}
SETS = {name: ViewSet(name, tuple(("Cam", frame) for frame in PSNR)) for name in ("novel_pose", "novel_view")}


def passed(count: int) -> Gallery:
    gallery = Gallery(SETS, count)
    image = np.zeros((2, 2, 3), np.uint8)
    for frame, psnr in PSNR.items():
        for name, more in (("novel_view", 0.0), ("novel_pose", -frame * 10.0)):
            gallery.pass_by(ShownView(name, "Cam", frame, image, {"student": image}, None), psnr + more)
    return gallery


def test_evenly_chosen_views_come_first_and_the_worst_of_the_set_last():
    kept = [(view.set, view.frame, view.chosen) for view in passed(2).views()]
    assert kept == [
        ("novel_pose", 0, "evenly"),
        ("novel_pose", 4, "evenly"),
        ("novel_pose", 3, "worst"),
        ("novel_view", 0, "evenly"),
        ("novel_view", 4, "evenly"),
        ("novel_view", 1, "worst"),  # the first of two that are as bad
    ]


def test_nothing_is_kept_where_nothing_is_shown():
    assert passed(0).views() == ()
