"""Settings of torch while models learn: the number of threads, and flushing of subnormals."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th

# Measured with two threads: networks of 16 units are 15 to 30 % faster with one thread, those of 32
# alike, those of 64 slower by as much (5000 parameters, 256 rows).
WORTH_SHARING = 5000 * 256

_SUBNORMAL, _ONE = np.float32(1e-40), np.float32(1)
# From 32768 numbers on, torch splits an operation among its threads.
_SHARED_AMONG_THREADS = 1 << 16


@contextmanager
def threads_for(multiply_adds: int) -> Iterator[None]:
    """Use one thread where the work, about parameters times rows, is too small to share.

    Example:
        >>> before = th.get_num_threads()
        >>> with threads_for(1000):
        ...     th.get_num_threads()
        1
        >>> th.get_num_threads() == before
        True
    """
    threads = th.get_num_threads()
    if threads == 1 or multiply_adds > WORTH_SHARING:
        yield
        return
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(threads)


@contextmanager
def flushed_subnormals() -> Iterator[None]:
    """Treat numbers below 1e-38 (float64: 1e-308) as 0, as GPUs and XLA do by default.

    A unit that is never active has gradients of 0. Adam's mean of them halves every seven updates,
    weight decay shrinks the unit's weights in the same way, and both end as subnormal numbers,
    which processors handle on a slow path: networks of 128 units slowed down to a tenth within 3000
    updates (docs/engine.md). If the program already flushes them, that setting stays. Where the
    processor cannot do it, nothing happens.

    Example:
        >>> with flushed_subnormals():
        ...     flushed = th.tensor(1e-40) * 1
        >>> bool(flushed == 0) or not th.set_flush_denormal(True)
        True
    """
    _start_threads(th.get_num_threads())
    if _SUBNORMAL * _ONE == 0 or not th.set_flush_denormal(True):
        yield
        return
    try:
        yield
    finally:
        th.set_flush_denormal(False)


@functools.cache
def _start_threads(count: int) -> None:
    """Start torch's threads outside the block: those that start inside keep flushing after it."""
    if count > 1:
        th.ones(_SHARED_AMONG_THREADS).add_(1)
