"""SIGTERM and Ctrl-C as a wish to stop, that waits for the end of the step."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

_WATCHED = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """Notes the first SIGINT or SIGTERM; a second one acts at once, as ever.

    Outside of the main thread, where Python does not let anybody watch signals, nothing is noted.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    def watch(self) -> None:
        """Note signals from now on, those excepted that the process ignores."""
        if threading.current_thread() is not threading.main_thread():
            return
        for number in _WATCHED:
            previous = signal.getsignal(number)
            if previous not in (None, signal.SIG_IGN) and number not in self._previous:
                self._previous[number] = previous
                signal.signal(number, self._note)

    def release(self) -> None:
        """Give signals back to whoever handled them before."""
        while self._previous:
            signal.signal(*self._previous.popitem())

    def deliver(self) -> None:
        """Act on what was noted as if it arrived now.

        Raises:
            KeyboardInterrupt: After SIGINT, unless the program handles that itself.
            SystemExit: With code 143 after SIGTERM, unless the program handles that itself.
        """
        number, self.received = self.received, None
        if number is None:
            return
        if signal.getsignal(number) is signal.SIG_DFL:
            # The default would end the process on the spot, without running anybody's `finally`.
            raise SystemExit(128 + number)
        signal.raise_signal(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        self.release()
        name = signal.Signals(number).name
        # Not print: it may have been interrupted itself.
        os.write(2, f"{name}: writing a checkpoint after this step, then stopping\n".encode())
