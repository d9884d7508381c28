"""Save and restore logs: the contents of log files, and values not yet written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    JSONOutputFormat,
    Logger,
    TensorBoardOutputFormat,
)

from sb3_flowpolicy.checkpoint.pickling import is_data


def log_files(logger: Logger) -> dict[str, IO[str]]:
    """Return the files that a logger writes text to, by format."""
    kinds = CSVOutputFormat | JSONOutputFormat | HumanOutputFormat
    return {
        type(one).__name__: one.file
        for one in logger.output_formats
        if isinstance(one, kinds) and getattr(one, "own_file", True)
    }


def read_texts(files: Mapping[str, IO[str]]) -> dict[str, str]:
    """Read open files completely, except deleted ones.

    Lengths would not suffice, because opening a log again empties it.
    """
    texts = {}
    for name, file in files.items():
        file.flush()
        if Path(file.name).is_file():
            texts[name] = Path(file.name).read_text()
    return texts


def write_texts(files: Mapping[str, IO[str]], texts: Mapping[str, str]) -> None:
    """Replace the contents of open files; files without a text stay as they are."""
    for name, file in files.items():
        if name in texts:
            file.seek(0)
            file.truncate()
            file.write(texts[name])
            file.flush()


def log_state(logger: Logger) -> dict[str, Any]:
    """Collect what a logger has written and will write next, except pictures."""
    kept = {key for key, value in logger.name_to_value.items() if is_data(value)}
    waiting = [
        {key: value for key, value in part.items() if key in kept} for part in _waiting(logger)
    ]
    return {"texts": read_texts(log_files(logger)), "waiting": waiting}


def set_log_state(logger: Logger, state: Mapping[str, Any], num_timesteps: int) -> None:
    """Restore what :func:`log_state` returned.

    TensorBoard will hide events after ``num_timesteps``.
    """
    for part, saved in zip(_waiting(logger), state["waiting"], strict=True):
        part.clear()
        part.update(saved)
    write_texts(log_files(logger), state["texts"])
    for one in logger.output_formats:
        if isinstance(one, CSVOutputFormat) and "CSVOutputFormat" in state["texts"]:
            header = state["texts"]["CSVOutputFormat"].partition("\n")[0]
            one.keys = header.split(one.separator) if header else []
        elif isinstance(one, TensorBoardOutputFormat):
            # The writer begins a new file with its next event, which marks where the run continues.
            one.writer.close()
            one.writer.purge_step = num_timesteps + 1


def _waiting(logger: Logger) -> tuple[dict[str, Any], ...]:
    """Return the values to be written next, the counts of their means, and excluded formats."""
    return logger.name_to_value, logger.name_to_count, logger.name_to_excluded
