"""The file format: a safetensors file whose metadata hold a configuration and a checksum.

The metadata have one entry, ``sb3_flowpolicy``: a JSON object with ``config`` and ``sha256``, the
checksum of the configuration and all arrays. safetensors writes several entries in random order;
with one entry, equal models give equal files.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import torch as th

from sb3_flowpolicy.common.files import replacing

MAX_HEADER_BYTES = 2**20
"""Bound on the header: parsing JSON takes up to 25 times its size. Large policies need a fifth."""

_KEY = "sb3_flowpolicy"

Arrays = dict[str, np.ndarray]


class BundleError(ValueError):
    """A bundle is invalid; the message names the file and says what was expected and found."""


def write(path: Path, config: Any, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a file completely or not at all; ``config`` is JSON data."""
    # safetensors copies memory as it lies; ascontiguousarray would make scalars one-dimensional.
    plain = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    content = canonical({"config": config, "sha256": checksum(config, plain)})
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft:
        safetensors.numpy.save_file(plain, draft, {_KEY: content})


def read(path: Path) -> tuple[Any, Arrays]:
    """Return the configuration and the arrays of a file; takes about its size in memory.

    Besides ``ValueError``, damaged files raise exceptions of the libraries.
    """
    if not path.is_file():  # opening a named pipe would block
        raise ValueError("not a regular file that exists")
    with path.open("rb") as file:
        header = int.from_bytes(file.read(8), "little")
    if header > MAX_HEADER_BYTES:
        raise ValueError(f"a header of {header} bytes, more than {MAX_HEADER_BYTES}")
    with safetensors.safe_open(path, framework="np") as opened:
        metadata = opened.metadata() or {}
        arrays = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    content = json.loads(metadata[_KEY])
    config, expected = content["config"], content["sha256"]
    found = checksum(config, arrays)
    if found != expected:
        raise ValueError(f"content was altered, its checksum is {found[:12]}..., not {expected}")
    return config, arrays


def canonical(value: Any) -> str:
    """Return the canonical JSON of a value: sorted keys, ASCII, neither NaN nor infinity."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def checksum(config: Any, arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of a configuration and of names, types, shapes and bytes of arrays."""
    table = [[name, arrays[name].dtype.str, arrays[name].shape] for name in sorted(arrays)]
    digest = hashlib.sha256(canonical([config, table]).encode())
    for name in sorted(arrays):
        digest.update(arrays[name].data)
    return digest.hexdigest()


def tensor_like(expected: th.Tensor, name: str, arrays: Mapping[str, np.ndarray]) -> th.Tensor:
    """Return an array as a tensor, after checking its type and shape."""
    found = th.from_numpy(arrays[name])
    if (found.dtype, found.shape) != (expected.dtype, expected.shape):
        raise ValueError(
            f"{name} must be {expected.dtype} of shape {tuple(expected.shape)}, got {found.dtype} "
            f"{tuple(found.shape)}"
        )
    return found
