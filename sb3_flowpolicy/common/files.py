"""Files that are written completely or not at all, and checked when they are read."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a file completely or not at all: an interruption leaves the old file.

    Yields:
        Path of a temporary file with the same suffix in the same folder, which replaces the file
        when the block ends without an exception.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with replacing(folder / "numbers.txt") as draft:
        ...     _ = draft.write_text("1 2 3")
        >>> [file.name for file in folder.iterdir()]
        ['numbers.txt']
    """
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    draft = Path(name)
    try:
        yield draft
        os.chmod(draft, 0o644)  # mkstemp's files are readable by their owner only
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file completely or not at all."""
    with replacing(path) as draft:
        draft.write_text(text)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file completely or not at all."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_json(path: Path, fields: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Read a JSON object and check the types of its fields (name -> type, or several types).

    Raises:
        ValueError: If the file is no JSON object, or a field is missing or of another type.
    """
    try:
        content = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:  # RecursionError: very deep nesting
        raise ValueError(f"{path} must be JSON, got {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold an object, got {type(content).__name__}")
    for name, kind in (fields or {}).items():
        if not isinstance(content.get(name), kind):
            wanted = " or ".join(one.__name__ for one in (kind if type(kind) is tuple else [kind]))
            found = repr(content.get(name, content))[:60]
            raise ValueError(f"{path} must hold {name!r} ({wanted}), got {found}")
    return content
