"""Argument types and error messages for the package's commands."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from sb3_flowpolicy.common.validation import integer


class HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Shows defaults, except None, which the help texts explain themselves."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        return action.help if action.default is None else super()._get_help_string(action)


def at_least(least: int) -> Callable[[str], int]:
    """Return a type for argparse: integers of at least ``least``.

    Example:
        >>> at_least(1)("3")
        3
        >>> at_least(1)("0")
        Traceback (most recent call last):
        ...
        argparse.ArgumentTypeError: value must be an integer of at least 1, got 0
    """

    def convert(text: str) -> int:
        try:
            return integer(least)("value", int(text))
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return convert


def assignment(text: str, sign: str = "=") -> tuple[str, Any]:
    """Type for argparse: ``NAME=VALUE`` with a YAML value.

    Example:
        >>> assignment("width=0.1")
        ('width', 0.1)
    """
    name, found, value = text.partition(sign)
    try:
        if name and found:
            return name, yaml.safe_load(value)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError):
        pass  # the value is no YAML
    raise argparse.ArgumentTypeError(f"must be NAME{sign}VALUE, got {text[:80]!r}")


def check_folder_of(parser: argparse.ArgumentParser, option: str, path: Path | None) -> None:
    """End with an error, before any work, if the file of an option cannot be written."""
    if path is not None and not path.absolute().parent.is_dir():
        parser.error(f"{option} must name a file in an existing directory, got {path}")


def run(main: Callable[[], Any]) -> None:
    """Run a command; print errors as one line, without a traceback."""
    try:
        main()
    # AssertionError comes from rl_zoo3, which checks its arguments with assert.
    except (ValueError, AssertionError, OSError, ImportError, gym.error.Error) as error:
        sys.exit(f"error: {error}")
