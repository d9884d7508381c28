"""How many threads work on what: two of them on a small network only wait for each other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th

# Measured with two threads: networks of 16 units are 15 to 30 % faster with one, those of 32
# alike, those of 64 slower by as much (5000 parameters, 256 rows).
WORTH_SHARING = 5000 * 256


@contextmanager
def threads_for(multiply_adds: int) -> Iterator[None]:
    """Work with one thread where there is too little to do for more.

    Args:
        multiply_adds: Size of the work: parameters times rows, about.

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
