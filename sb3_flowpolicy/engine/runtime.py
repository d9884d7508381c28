"""Binds models to an engine for as long as they learn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from sb3_flowpolicy.engine.arithmetic import flushed_subnormals, threads_for
from sb3_flowpolicy.engine.engine import Engine, why_unsupported

# Compiling takes 10 to 30 seconds and saves one to five milliseconds per update.
UPDATES_WORTH_COMPILING = 10_000


class EngineRuntime:
    """The engine of models that learn together.

    Between :meth:`running` and its end the models' parameters and optimizer states are views of the
    engine's tensors. Callbacks may load parameters, reset optimizers, replace networks or change
    settings meanwhile, so with callbacks the binding is checked before every use; else once.

    Args:
        models: Models that differ only in weights, data and random numbers. Their attributes
            ``compile`` and ``autocast`` and their method ``objective()`` say how to update them.
        refuse: Called with a reason when the engine does not support the models.
    """

    def __init__(self, models: Sequence[Any], refuse: Callable[[str], None]) -> None:
        self.models = models
        # Number of updates of the models before their first call of ``learn``, and after this one.
        self._first: int | None = None
        self._last = 0.0
        self._refuse = refuse
        self._engine: Engine | None = None
        self._running = self._checked = self._refused = False
        self._watched = True

    @property
    def is_running(self) -> bool:
        """Whether the models may be bound."""
        return self._running

    @property
    def compiles(self) -> bool:
        """Whether the models' settings, and the number of planned updates, ask for compiling."""
        wanted = self.models[0].compile
        if wanted != "auto":
            return bool(wanted)
        # Many short calls of ``learn``, with tests in between, repay compiling as a long one does.
        return self._last - (self._first or 0) >= UPDATES_WORTH_COMPILING

    def plan(self, updates: float) -> None:
        """Note that a call of ``learn`` begins.

        Args:
            updates: Number of updates that it is going to do.
        """
        done = self.models[0]._n_updates
        self._first = done if self._first is None else self._first
        self._last = done + updates

    @contextmanager
    def running(self, watched: bool = True) -> Iterator[None]:
        """Bind the models at their first use within this context, and release them at its end.

        The context also sets torch's number of threads and flushes subnormal numbers. Contexts may
        be nested: the outermost counts.

        Args:
            watched: Whether callbacks may change the models meanwhile.
        """
        if self._running:
            yield
            return
        first = self.models[0]
        size = sum(parameter.numel() for parameter in first.policy.parameters())
        self._running, self._watched = True, watched
        self._checked = self._refused = False
        try:
            with threads_for(size * first.batch_size), flushed_subnormals():
                yield
        finally:
            self._running = False
            if self._engine is not None:
                self._engine.release()

    def engine(self) -> Engine | None:
        """Return the engine, bound to the models as they are now; None if it does not support them.

        To be called within :meth:`running`.
        """
        if self._checked and not self._watched:
            return self._engine
        self._checked = True
        if self._refused:
            return None
        engine = self._engine
        if engine is not None:
            # What was compiled once is kept: eager updates would be slower.
            same = (
                (engine.compiled or not self.compiles)
                and engine.autocast == self.models[0].autocast
                and engine.fits(self.models)
            )
            if same and not engine.synchronize():
                return engine
            if not same:
                self.drop()
        reason = why_unsupported(self.models[0])
        if reason is not None:
            self.drop()
            self._refused = True
            self._refuse(reason)
        elif self._engine is None:
            self._engine = Engine(self.models, self.compiles, self.models[0].autocast)
        return self._engine

    def drop(self) -> None:
        """Discard the engine: the models keep their values in memory of their own."""
        if self._engine is not None:
            self._engine.release()
            self._engine = None

    def state(self) -> dict[str, int | None]:
        """Return what a checkpoint stores."""
        return {"first": self._first}

    def load_state(self, state: dict[str, int | None]) -> None:
        """Restore what :meth:`state` returned."""
        self._first = state["first"]
