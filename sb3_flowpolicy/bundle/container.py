"""The file: a safetensors file whose every byte is accounted for.

======================  =========================================================================
8 bytes                 length N of the header, little endian
N bytes                 the header, JSON, padded with spaces to a multiple of 8
the rest                the arrays, one after the other, without gaps
======================  =========================================================================

So says the safetensors format, and every reader of it can open a bundle. A bundle is stricter:
the header is the one string that our writer would write, and its first entry, always at the same
place, is the SHA-256 of all other bytes. Two equal models are two equal files.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import stat
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

#: A policy of a hundred layers needs a fifth of it.
MAX_HEADER_BYTES = 2**20
_PREFIX = b'{"__metadata__":{"checksum":"'
_NO_DIGEST = "0" * 64
_DTYPES = {
    "F64": "<f8",
    "F32": "<f4",
    "F16": "<f2",
    "I64": "<i8",
    "I32": "<i4",
    "I16": "<i2",
    "I8": "|i1",
    "U64": "<u8",
    "U32": "<u4",
    "U16": "<u2",
    "U8": "|u1",
    "BOOL": "|b1",
}
_CODES = {np.dtype(name): code for code, name in _DTYPES.items()}

Arrays = dict[str, np.ndarray]


class BundleError(ValueError):
    """A bundle that is refused: the message says which file, what was expected and what came."""


def write_container(
    path: Path, config: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> None:
    """Write a file at once or not at all.

    Args:
        path: File to create or replace.
        config: What JSON can hold: strings, integers, finite floats, booleans, None, lists, dicts.
        arrays: Arrays of numbers or booleans.

    Raises:
        ValueError: If an array's type has no place in the format, or the header gets too long.
    """
    plain = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    for name, array in plain.items():
        if array.dtype not in _CODES:
            raise ValueError(f"{name} must be of a type among {list(_DTYPES)}, got {array.dtype}")
        if not array.size:
            raise ValueError(f"{name} must have elements, got shape {array.shape}")
        # ascontiguousarray makes scalars one-dimensional.
        plain[name] = array.reshape(np.shape(arrays[name]))
    order = sorted(plain, key=lambda name: _rank(name, plain[name].dtype))
    table, offset = {}, 0
    for name in order:
        end = offset + plain[name].nbytes
        table[name] = _entry(_CODES[plain[name].dtype], plain[name].shape, offset, end)
        offset = end
    header = _header(_encode(config), table)
    if len(header) > MAX_HEADER_BYTES:
        raise ValueError(
            f"settings and names of arrays must fit in {MAX_HEADER_BYTES} bytes, got {len(header)}"
        )
    chunks = [plain[name].reshape(-1).view(np.uint8).data for name in order]
    digest = hashlib.sha256(len(header).to_bytes(8, "little") + header)
    for chunk in chunks:
        digest.update(chunk)
    _write_atomically(path, [*_sealed(header, digest.hexdigest()), *chunks])


def read_container(path: Path) -> tuple[Any, Arrays]:
    """Read what :func:`write_container` wrote, in memory of about the file's size.

    Nothing is interpreted before the checksum holds but the table of arrays, and nothing is
    allocated that the file does not have the bytes for.

    Returns:
        The configuration as JSON gives it, and the arrays, writable.

    Raises:
        BundleError: If the file is not exactly one that :func:`write_container` writes.
    """
    try:
        # A named pipe would otherwise be waited for.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        try:
            status = os.fstat(handle)
            if not stat.S_ISREG(status.st_mode):
                raise BundleError("must be a regular file")
            with open(handle, "rb", closefd=False) as file:
                return _read(file, status.st_size)
        finally:
            os.close(handle)
    except BundleError as error:
        raise BundleError(f"{path} {error}") from error
    except (OSError, ValueError, MemoryError) as error:
        raise BundleError(f"{path} must be a file that can be read, got {error}") from error


def _read(file: BinaryIO, size: int) -> tuple[Any, Arrays]:
    start = file.read(8 + len(_PREFIX))
    if start[8:] != _PREFIX:
        raise BundleError(f"must be a bundle written by save_safe, but begins with {start[:24]!r}")
    length = int.from_bytes(start[:8], "little")
    if not len(_PREFIX) + 64 <= length <= min(MAX_HEADER_BYTES, size - 8):
        most = min(MAX_HEADER_BYTES, size - 8)
        raise BundleError(f"must have a header of at most {most} bytes, got {length}")
    rest = file.read(length - len(_PREFIX))
    found, blank = rest[:64], _NO_DIGEST.encode()
    header = _PREFIX + blank + rest[64:]
    config, table = _parse_header(header)
    expected = 8 + length + max((entry["data_offsets"][1] for entry in table.values()), default=0)
    if expected != size:
        raise BundleError(f"must have {expected} bytes, got {size}: was it cut off?")
    digest = hashlib.sha256(start[:8] + header)
    arrays: Arrays = {}
    for name, entry in table.items():
        array = np.empty(entry["shape"], _DTYPES[entry["dtype"]])
        view = array.reshape(-1).view(np.uint8).data
        if file.readinto(view) != len(view):  # type: ignore[attr-defined]
            raise BundleError("must not change while it is read")
        digest.update(view)
        arrays[name] = array
    if digest.hexdigest().encode() != found:
        raise BundleError(
            f"must have the checksum it was written with, {found[:12]!r}..., got "
            f"{digest.hexdigest()[:12]}...: bytes were altered"
        )
    return _decode(config), arrays


def _parse_header(header: bytes) -> tuple[str, dict[str, Any]]:
    """Return the configuration's string and the table of arrays, in the order of their bytes."""
    try:
        content = json.loads(header.decode("ascii"), object_pairs_hook=_checked_entry)
    except (ValueError, RecursionError) as error:
        raise BundleError(f"must have a header as save_safe writes it, got {error}") from error
    metadata, table = content.pop("__metadata__", {}), content
    if list(metadata) != ["checksum", "config", "format"] or metadata["format"] != "sb3_flowpolicy":
        raise BundleError(f"must have the metadata of a bundle, got {sorted(metadata)}")
    order = sorted(table, key=lambda name: _rank(name, np.dtype(_DTYPES[table[name]["dtype"]])))
    # Whatever else JSON would let pass (other blanks, other escapes, other order) ends here.
    if _header(metadata["config"], {name: table[name] for name in order}) != header:
        raise BundleError("must have a header as save_safe writes it, got another way to say it")
    return metadata["config"], table


def _checked_entry(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Check an object of the header as soon as it is complete: innermost first."""
    entry = dict(pairs)
    if len(entry) != len(pairs):
        raise ValueError("a key twice")
    if "__metadata__" in entry:
        offset = 0
        for name, value in pairs[1:]:
            if not isinstance(value, dict) or "data_offsets" not in value:
                raise ValueError(f"no array behind {name[:60]!r}")
            begin, end = value["data_offsets"]
            if begin != offset:
                raise ValueError(f"a gap before {name[:60]!r}")
            offset = end
        if not isinstance(entry["__metadata__"], dict):
            raise ValueError("metadata that is no object")
        return entry
    if set(entry) == {"data_offsets", "dtype", "shape"}:
        return _checked_array(entry)
    if not all(isinstance(value, str) for value in entry.values()):
        raise ValueError(f"unknown keys {sorted(entry)[:5]}")
    return entry


def _checked_array(entry: dict[str, Any]) -> dict[str, Any]:
    offsets, shape = entry["data_offsets"], entry["shape"]
    for numbers in (offsets, shape):
        if not isinstance(numbers, list) or len(numbers) > 32:
            raise ValueError(f"no list of sizes but {str(numbers)[:60]}")
        # bool is a subclass of int.
        if not all(type(number) is int and 0 <= number < 2**40 for number in numbers):
            raise ValueError(f"no sizes but {str(numbers)[:60]}")
    if not isinstance(entry["dtype"], str) or entry["dtype"] not in _DTYPES or len(offsets) != 2:
        raise ValueError(f"no array but {str(entry)[:60]}")
    n_bytes = math.prod(shape) * np.dtype(_DTYPES[entry["dtype"]]).itemsize
    if not 0 < n_bytes == offsets[1] - offsets[0]:
        raise ValueError(f"{offsets[1] - offsets[0]} bytes for shape {shape}")
    return entry


def _rank(name: str, dtype: np.dtype) -> tuple[int, str]:
    """Wide types first, so that each array begins at a multiple of its item's size."""
    return -dtype.itemsize, name


def _entry(code: str, shape: tuple[int, ...], begin: int, end: int) -> dict[str, Any]:
    return {"data_offsets": [begin, end], "dtype": code, "shape": list(shape)}


def _header(config: str, table: Mapping[str, Any]) -> bytes:
    """Return the header with a checksum of zeros."""
    metadata = {"checksum": _NO_DIGEST, "config": config, "format": "sb3_flowpolicy"}
    content = {"__metadata__": metadata, **table}
    text = json.dumps(content, separators=(",", ":"), ensure_ascii=True)
    return (text + " " * (-len(text) % 8)).encode("ascii")


def _sealed(header: bytes, digest: str) -> Iterator[bytes]:
    yield len(header).to_bytes(8, "little")
    yield _PREFIX + digest.encode() + header[len(_PREFIX) + 64 :]


def _encode(config: Any) -> str:
    return json.dumps(config, separators=(",", ":"), sort_keys=True, allow_nan=False)


def _decode(text: str) -> Any:
    try:
        config = json.loads(text)
        if _encode(config) != text:
            raise BundleError(
                "must have settings as save_safe writes them, got another way to say it"
            )
    except (ValueError, RecursionError) as error:
        raise BundleError(f"must have settings in JSON, got {error}") from error
    return config


def _write_atomically(path: Path, chunks: list[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(prefix=path.name, suffix=".tmp", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            for chunk in chunks:
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)  # mkstemp's files are for their owner alone
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
