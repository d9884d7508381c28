"""Defer SIGTERM and Ctrl-C to the end of a step."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

_WATCHED = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """Notes the first SIGINT or SIGTERM; a second one takes effect at once.

    Does nothing outside the main thread, where Python does not handle signals.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    def watch(self) -> None:
        """Note signals from now on, except those that the process ignores."""
        self.received = None
        if threading.current_thread() is not threading.main_thread():
            return
        for number in _WATCHED:
            previous = signal.getsignal(number)
            if previous not in (None, signal.SIG_IGN) and number not in self._previous:
                self._previous[number] = previous
                signal.signal(number, self._note)

    def release(self) -> None:
        """Restore the previous signal handlers."""
        while self._previous:
            signal.signal(*self._previous.popitem())

    def deliver(self) -> None:
        """Deliver the noted signal as if it arrived now.

        Raises:
            KeyboardInterrupt: After SIGINT, unless the program handles that itself.
            SystemExit: With code 143 after SIGTERM, unless the program handles that itself.
        """
        number, self.received = self.received, None
        if number is None:
            return
        if signal.getsignal(number) is signal.SIG_DFL:
            # The default would end the process at once, without running any `finally`.
            raise SystemExit(128 + number)
        signal.raise_signal(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        self.release()
        name = signal.Signals(number).name
        # Not print: it may have been interrupted itself.
        os.write(2, f"{name}: writing a checkpoint after this step, then stopping\n".encode())
