"""Pickles of objects that refer to existing ones: environments, agents, callbacks."""

from __future__ import annotations

import io
import pickle
import sys
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from types import FunctionType
from typing import Any

import cloudpickle
import numpy as np
import torch as th

# Objects of these packages pickle as handles that are meaningless in another process.
_SIMULATORS = ("pybullet",)

_DATA = (bool, int, float, str, bytes, Path, np.ndarray, np.generic, np.random.Generator, th.Tensor)


def is_data(value: Any) -> bool:
    """Whether a value consists of numbers, text and arrays only.

    Example:
        >>> is_data({"best": 1.5, "all": [1, 2]}), is_data(print)
        (True, False)
    """
    if isinstance(value, Mapping):
        return all(map(is_data, value.keys())) and all(map(is_data, value.values()))
    if isinstance(value, list | tuple | set | deque):
        return all(map(is_data, value))
    return value is None or isinstance(value, _DATA)


def dumps(value: Any, known: Mapping[str, object]) -> bytes:
    """Pickle ``value``; objects in ``known`` are stored by name, without their contents."""
    file = io.BytesIO()
    _Pickler(file, {id(thing): name for name, thing in known.items()}).dump(value)
    return file.getvalue()


def loads(pickled: bytes, known: Mapping[str, object]) -> Any:
    """Unpickle what :func:`dumps` returned; names that are not ``known`` become None."""
    return _Unpickler(io.BytesIO(pickled), known).load()


class _Pickler(cloudpickle.Pickler):
    def __init__(self, file: io.BytesIO, names: Mapping[int, str]) -> None:
        super().__init__(file)
        self._names = names

    def persistent_id(self, thing: object) -> str | None:
        name = self._names.get(id(thing))
        if name is None and type(thing).__module__.startswith(_SIMULATORS):
            raise pickle.PicklingError(f"{type(thing).__name__} lives outside of Python")
        return name

    def reducer_override(self, thing: Any) -> Any:
        # cloudpickle would copy classes of the main program. A resumed program defines them again,
        # and would then have two different classes of the same name.
        named = isinstance(thing, type | FunctionType) and thing.__module__ == "__main__"
        if named and getattr(sys.modules["__main__"], thing.__qualname__, None) is thing:
            return NotImplemented
        return super().reducer_override(thing)


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, known: Mapping[str, object]) -> None:
        super().__init__(file)
        self._known = known

    def persistent_load(self, name: str) -> object:
        return self._known.get(name)
