"""Ways to spoil a bundle: at random, and with knowledge of the format."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.bundle.conftest import assembled, parts_of, sealed

Rng = np.random.Generator
HOSTILE: list[Any] = [
    *(None, True, False, 0, 1, -1, 2, 7, 255, 10**9, 2**31, 2**40, 2**63, -(2**63), 10**30),
    *(0.5, -0.5, 1e-300, 1e308, -0.0, "", "x", "inf", "nan", "auto", "auto_0.1", "../../etc", "\0"),
    *("os.system", "RealNVP", "ReLU", "F32", "F64", "Dict", "Box", "é\u2028", "y" * 5000),
    *([], {}, [[]], [{}], {"": {}}, [0], [10**9], [16] * 2000, {"pi": [10**9]}, {"type": "Box"}),
    *({"layers": 10**9}, {"hidden": [10**6] * 3}, {"hidden": [1] * 9000}, {"rank": 2}, {"x": None}),
    *({"schedule": "linear", "start": 1e-3, "end": 0.0, "end_fraction": 1}, [1, "step"], [[[[0]]]]),
]


class Evil:
    """Unpickling this writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def places(tree: Any, where: tuple = ()) -> list[tuple]:
    """Return all keys and indices in a tree of dicts and lists, as paths."""
    found = []
    entries: Any = ()
    if isinstance(tree, dict):
        entries = tree.items()
    elif isinstance(tree, list):
        entries = enumerate(tree)
    for key, value in entries:
        found += [(*where, key), *places(value, (*where, key))]
    return found


def spoil_tree(tree: Any, rng: Rng) -> None:
    """Replace, remove, add, rename or copy something in it."""
    path = _pick(places(tree), rng)
    parent = tree
    for key in path[:-1]:
        parent = parent[key]
    key = path[-1]
    action = rng.integers(6)
    if action == 0:
        del parent[key]
    elif action == 1 and isinstance(parent, dict):
        parent[_pick(["", "x", "seed", "net_arch", "__class__", "é"], rng)] = _pick(HOSTILE, rng)
    elif action == 2 and isinstance(parent, dict):
        parent[str(key) + "_"] = parent.pop(key)
    elif action == 3:
        source = tree
        for step in _pick(places(tree), rng):
            source = source[step]
        parent[key] = copy.deepcopy(source)
    elif action == 4 and isinstance(parent[key], int | float):
        parent[key] = parent[key] * _pick([2, -1, 10, 1e6, 0.1], rng) + _pick([0, 1, -1], rng)
    else:
        parent[key] = copy.deepcopy(_pick(HOSTILE, rng))


def by_chance(content: bytes, rng: Rng) -> bytes:
    """Damage as by disks, networks and editors; the checksum stays as it is."""
    raw = bytearray(content)
    place = int(rng.integers(len(raw)))
    # Half of the places are in the header, which is a small part of the file.
    if rng.random() < 0.5:
        header = 8 + int.from_bytes(content[:8], "little")
        place = int(rng.integers(min(header, len(raw))))
    action = rng.integers(6)
    some = rng.bytes(int(rng.integers(1, 50)))
    if action == 0:
        raw[place] ^= 1 << int(rng.integers(8))
    elif action == 1:
        raw[place : place + len(some)] = some[: len(raw) - place]
    elif action == 2:
        del raw[place:]
    elif action == 3:
        raw[place:place] = some
    elif action == 4:
        del raw[place : place + len(some)]
    else:
        raw += some
    return bytes(raw)


def spoil_config(content: bytes, rng: Rng) -> bytes:
    header, config, data = parts_of(content)
    for _ in range(int(rng.integers(1, 3))):
        spoil_tree(config, rng)
    return sealed(header, config, data)


def spoil_table(content: bytes, rng: Rng) -> bytes:
    header, config, data = parts_of(content)
    metadata = header.pop("__metadata__")
    spoil_tree(header, rng)
    return sealed({"__metadata__": metadata, **header}, config, data)


def spoil_metadata(content: bytes, rng: Rng) -> bytes:
    header, _, data = parts_of(content)
    spoil_tree(header["__metadata__"], rng)
    return assembled(header, data)


def spoil_text(content: bytes, rng: Rng) -> bytes:
    """Write the same configuration differently, or something that is no JSON."""
    header, config, data = parts_of(content)
    text = json.dumps(config)
    place = int(rng.integers(len(text)))
    deep = "[" * 100_000
    some = _pick(
        [" ", "\n", "0", "e9", "NaN", "{", "]", ",", '"', "\\u0000", deep, "1" * 5000], rng
    )
    text = text[:place] + some + text[place + int(rng.integers(2)) :]
    return sealed(header, text, data)


def spoil_data(content: bytes, rng: Rng) -> bytes:
    """Write other numbers into the arrays, with a valid checksum."""
    header, config, data = parts_of(content)
    raw = bytearray(data)
    place = int(rng.integers(len(raw) // 4)) * 4
    some = _pick([b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\xff\xff", rng.bytes(8)], rng)
    raw[place : place + len(some)] = some[: len(raw) - place]
    return sealed(header, config, bytes(raw))


def exchange_arrays(content: bytes, rng: Rng) -> bytes:
    """Exchange the places of two arrays."""
    header, config, data = parts_of(content)
    names = [name for name in header if name != "__metadata__"]
    one, other = _pick(names, rng), _pick(names, rng)
    header[one], header[other] = header[other], header[one]
    return sealed(header, config, data)


KNOWING: list[Callable[[bytes, Rng], bytes]] = [
    *[spoil_config] * 4,
    spoil_table,
    spoil_metadata,
    spoil_text,
    spoil_data,
    exchange_arrays,
]


def _pick(options: list[Any], rng: Rng) -> Any:
    return options[int(rng.integers(len(options)))]
