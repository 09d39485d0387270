"""Compiling kernels, with and without a folder for the cache, and running them in blocks."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

import beambox.ops.jit as jit_module
from beambox.ops.jit import jit, parallel_for

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("length", [0, 1, 2, 7, 100])
def test_run_in_blocks_covers_every_item_once(threads, count, length):
    threads(count)
    seen = np.zeros(length, int)
    workers = set()

    def kernel(start, stop):
        workers.add(threading.get_ident())
        seen[start:stop] += 1

    parallel_for(kernel, length)
    assert (seen == 1).all()
    assert len(workers) <= count


def test_run_in_blocks_hands_on_an_error_of_any_block(threads):
    threads(2)

    def kernel(start, stop):
        if start > 0:
            raise ZeroDivisionError("in the second block")

    with pytest.raises(ZeroDivisionError, match="second block"):
        parallel_for(kernel, 10)


def test_run_in_blocks_keeps_short_work_on_one_thread(threads):
    threads(2)
    blocks = []
    parallel_for(lambda start, stop: blocks.append((start, stop)), 10, smallest=8)
    assert blocks == [(0, 10)]


def test_jit_works_where_no_cache_folder_can_be_written(tmp_path):
    (tmp_path / "kernel.py").write_text(
        "from beambox.ops.jit import jit\n@jit\ndef twice(x):\n    return 2 * x\nprint(twice(21))\n"
    )
    script = (
        "import numba.core.caching as caching\n"
        "caching.CacheImpl._locator_classes = []\n"  # as on a read-only file system: no locator fits
        "import runpy; runpy.run_path('kernel.py')"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "42"


def test_jit_compiles(tmp_path):
    assert jit(lambda x: x + 1)(np.float32(1)) == 2


def test_helpers_that_are_busy_elsewhere_are_not_waited_for(threads):
    threads(2)
    parallel_for(lambda start, stop: None, 10)  # so that there are helpers
    release, seen = threading.Event(), np.zeros(10, int)
    pool = jit_module._pool()
    for _ in range(pool._max_workers):
        pool.submit(release.wait)

    def kernel(start, stop):
        seen[start:stop] += 1

    try:
        parallel_for(kernel, 10)
        assert (seen == 1).all()
    finally:
        release.set()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_forked_process_has_helpers_of_its_own(threads):
    threads(2)
    parallel_for(lambda start, stop: None, 10)
    child = os.fork()
    if child == 0:  # pragma: no cover
        signal.alarm(20)  # a helper that does not exist would be waited for
        seen = np.zeros(10, int)

        def kernel(start, stop):
            seen[start:stop] += 1

        parallel_for(kernel, 10)
        os._exit(0 if (seen == 1).all() else 1)
    assert os.waitpid(child, 0)[1] == 0
