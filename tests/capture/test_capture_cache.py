"""The cache's bound, threads, forked and spawned workers."""

from __future__ import annotations

import multiprocessing
import sys
import threading

import numpy as np
import pytest

from smplxpp.capture import open_capture
from smplxpp.capture.views import ArrayCache
from tests.capture.scene import make_scene
from tests.capture.writers import write_simple


def test_the_bound_holds_and_the_oldest_go_first():
    cache, made = ArrayCache(1000), []

    def make(k):
        made.append(k)
        return (np.full(300, k, dtype=np.uint8),)

    for k in (0, 1, 2, 0, 3, 0, 1):
        assert cache.get(k, lambda k=k: make(k))[0][0] == k
        assert cache.held_bytes <= 1000
    # 3 pushed out 1, the least recently used; 0 stayed.
    assert made == [0, 1, 2, 3, 1]


def test_what_is_larger_than_the_bound_is_not_kept():
    cache = ArrayCache(100)
    assert cache.get("big", lambda: (np.zeros(101, np.uint8),))[0].shape == (101,)
    assert cache.held_bytes == 0


def test_threads_share_one_cache():
    cache, wrong = ArrayCache(50_000), []
    # Threads take turns a thousand times as often as by default (5 ms), so that one reads amid another's change.
    interval = sys.getswitchinterval()
    sys.setswitchinterval(5e-6)

    def work(seed):
        for k in np.random.default_rng(seed).integers(0, 40, 400):
            array = cache.get(int(k), lambda k=k: (np.full(2000, k, dtype=np.uint8),))[0]
            if (array != k).any() or cache.held_bytes > 50_000:
                wrong.append(k)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    sys.setswitchinterval(interval)
    assert wrong == []
    assert cache.held_bytes == sum(2000 for _ in range(25))


def _mean_in_worker(capture, views, out):
    out.put((capture.cache.held_bytes, [float(capture.composited(*view, (0, 1, 0)).mean()) for view in views]))


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_workers_start_empty_and_read_the_same(tmp_path, method):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {method} here")
    capture = open_capture(write_simple(make_scene(), tmp_path / "rig")).resized(0.5)
    views = capture.views()
    here = [float(capture.composited(*view, (0, 1, 0)).mean()) for view in views]
    assert capture.cache.held_bytes > 0
    context = multiprocessing.get_context(method)
    out = context.Queue()
    worker = context.Process(target=_mean_in_worker, args=(capture, views, out))
    worker.start()
    held, there = out.get(timeout=900)
    worker.join(timeout=900)
    assert (held, there) == (0, here)
