"""A folder of checkpoints: written atomically, checked when read, the last good ones kept."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FORMAT = 1
"""Version of what is on disk; raised when older versions of this package could not read it."""

KEPT = 2
_NAME = re.compile(r"\d+-step-\d+")
_MANIFEST = "manifest.json"
_ROWS = "replay"
_PARTIAL = ".partial"


@dataclass(frozen=True)
class Checkpoint:
    """A complete checkpoint: its folder and its manifest (``kind``, ``num_timesteps``, ...)."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def rows_folder(self) -> Path:
        """The folder with the files of the replay buffer, which several checkpoints share."""
        return self.folder.parent / _ROWS


class CheckpointStore:
    """The checkpoints of one run.

    A checkpoint is a folder such as ``00007-step-70000``. Its files, and the rows added since the
    previous checkpoint, are first written to a temporary folder and synchronized; renaming that
    folder completes the checkpoint. A manifest lists the SHA-256 of every file, including those of
    earlier rows.

    Args:
        path: Folder of the checkpoints, made with the first one.
        good: Checkpoints in it that are known to be undamaged, oldest first.
    """

    def __init__(self, path: str | Path, good: Sequence[Checkpoint] = ()) -> None:
        self.path = Path(path).resolve()
        self._good = list(good)

    def folders(self) -> list[Path]:
        """Return the folders of checkpoints, damaged ones included, oldest first."""
        found = self.path.glob("[0-9]*-step-*")
        return sorted((one for one in found if _NAME.fullmatch(one.name)), key=_number)

    def newest(self) -> Checkpoint:
        """Return the newest checkpoint that is undamaged; ``ValueError`` if there is none."""
        checkpoint, damages = self._search()
        damaged = "; ".join(damages)
        if checkpoint is None:
            found = f"only damaged ones ({damaged})" if damages else "no checkpoint"
            raise ValueError(
                f"path must be a folder of checkpoints, got {str(self.path)!r}, which has {found}"
            )
        if damages:
            warnings.warn(
                f"resuming from {checkpoint.folder}, because newer checkpoints are damaged "
                f"({damaged})",
                RuntimeWarning,
                stacklevel=3,
            )
        return checkpoint

    def _search(self) -> tuple[Checkpoint | None, list[str]]:
        """Return the newest undamaged checkpoint, and what is wrong with newer ones."""
        damages: list[str] = []
        for folder in reversed(self.folders()):
            try:
                return Checkpoint(folder, _read_manifest(folder)), damages
            except _DamagedError as damage:
                damages.append(f"{folder.name}: {damage}")
        return None, damages

    def write(
        self,
        num_timesteps: int,
        facts: dict[str, Any],
        write_files: Callable[[Path, Path], dict[str, Any]],
    ) -> Checkpoint:
        """Write a checkpoint, then delete those that are no longer needed.

        Args:
            num_timesteps: Environment steps so far.
            facts: Entries of the manifest.
            write_files: Function of the checkpoint's folder and of a prefix for files of new rows.
                Writes files and returns further entries, such as the ``segments`` of all rows.
        """
        number = max(map(_number, self.folders()), default=0) + 1
        name = f"{number:05d}-step-{num_timesteps}"
        partial, rows = self.path / f"{_PARTIAL}-{name}", self.path / _ROWS
        for leftover in self.path.glob(f"{_PARTIAL}-*"):
            shutil.rmtree(leftover)
        partial.mkdir(parents=True)
        rows.mkdir(exist_ok=True)
        facts = {"format": FORMAT, "num_timesteps": num_timesteps, **facts}
        facts |= write_files(partial, rows / f"{number:05d}")
        own = {f"{name}/{path.name}": _digest(path, True) for path in sorted(partial.iterdir())}
        known = self._good[-1].manifest["files"] if self._good else {}
        for segment in facts.get("segments", []):
            key = f"{_ROWS}/{segment['file']}"
            own[key] = known[key] if key in known else _digest(self.path / key, True)
        facts["files"] = own
        manifest = partial / _MANIFEST
        manifest.write_text(json.dumps({**facts, "sha256": _seal(facts)}, indent=1))
        for path in (manifest, partial, rows):
            _synchronize(path)
        partial.rename(self.path / name)
        _synchronize(self.path)
        checkpoint = Checkpoint(self.path / name, facts)
        self._good = [*self._good, checkpoint][-KEPT:]
        self._tidy()
        return checkpoint

    def _tidy(self) -> None:
        """Delete all but the last good checkpoints, and the rows that only the others need."""
        kept = {checkpoint.folder for checkpoint in self._good}
        for folder in self.folders():
            if folder not in kept:
                shutil.rmtree(folder)
        needed = {name for checkpoint in self._good for name in checkpoint.manifest["files"]}
        for path in (self.path / _ROWS).iterdir():
            if f"{_ROWS}/{path.name}" not in needed:
                path.unlink()


def has_checkpoint(path: str | Path) -> bool:
    """Whether a folder holds a checkpoint to resume from.

    Example:
        >>> has_checkpoint("no/such/folder")
        False
    """
    return CheckpointStore(path)._search()[0] is not None


def _number(folder: Path) -> int:
    return int(folder.name.split("-")[0])


class _DamagedError(Exception):
    """A checkpoint disagrees with its manifest."""


def _read_manifest(folder: Path) -> dict[str, Any]:
    """Read a manifest and check the files that it lists."""
    try:
        facts = json.loads((folder / _MANIFEST).read_bytes())
        seal = facts.pop("sha256")
    except (OSError, ValueError, AttributeError, KeyError, TypeError):
        raise _DamagedError(f"{_MANIFEST} cannot be read") from None
    if seal != _seal(facts):
        raise _DamagedError(f"{_MANIFEST} was altered")
    if facts["format"] > FORMAT:
        raise ValueError(
            f"path must hold checkpoints of format {FORMAT} or earlier, got format "
            f"{facts['format']} in {folder}: a newer sb3_flowpolicy wrote it"
        )
    for name, digest in facts["files"].items():
        path = folder.parent / name
        if not path.is_file():
            raise _DamagedError(f"{name} is missing")
        if _digest(path) != digest:
            raise _DamagedError(f"{name} was altered or cut short")
    return facts


def _seal(facts: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _digest(path: Path, synchronize: bool = False) -> str:
    """Return a file's SHA-256, optionally after making sure that it is on the disk."""
    if synchronize:
        _synchronize(path)
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _synchronize(path: Path) -> None:
    """Wait until a file's contents, or a folder's entries, are on the disk."""
    if path.is_dir() and os.name == "nt":
        return  # Windows cannot synchronize folders
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
