"""Numbers too small to matter, which cost a hundred times as much as others."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th

_SUBNORMAL, _ONE = np.float32(1e-40), np.float32(1)
# From 32768 numbers on torch shares an operation among its threads.
_SHARED_AMONG_THREADS = 1 << 16


@contextmanager
def flushed_subnormals() -> Iterator[None]:
    """Take numbers below 1e-38 (float64: 1e-308) to be 0, as GPUs and XLA do by default.

    A unit that is never active has gradients of 0. Adam's mean of them halves every seven updates,
    weight decay drives the unit's weights the same way, and both end as subnormal numbers, on which
    processors leave their fast path: networks of 128 units slowed down to a tenth within 3000
    updates (docs/engine.md). Whoever has asked torch to flush them keeps that; elsewhere nothing
    changes after the block. Where a processor cannot do it, nothing happens.

    Example:
        >>> with flushed_subnormals():
        ...     flushed = th.tensor(1e-40) * 1
        >>> bool(flushed == 0) or not th.set_flush_denormal(False)
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
    """Start torch's threads outside the block: those that start within keep flushing after it."""
    if count > 1:
        th.ones(_SHARED_AMONG_THREADS).add_(1)
