"""Binds models to an engine for as long as they learn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Generic, Protocol, TypeVar

from sb3_flowpolicy.engine.arithmetic import flushed_subnormals, threads_for

# Compiling pays after 1800 to 5000 updates, depending on width, density, and the number of seeds
# (docs/engine.md).
UPDATES_WORTH_COMPILING = 5000


class Bound(Protocol):
    """What a runtime asks of an engine."""

    compiled: bool

    def fits(self, models: Sequence[Any]) -> bool:
        """Whether these still are the models, with the same networks, optimizers and constants."""

    def synchronize(self) -> bool:
        """Take over what was loaded or moved since the last update; return whether anything was."""

    def release(self) -> None:
        """Give modules and optimizers memory of their own, until :meth:`synchronize`."""


BoundT = TypeVar("BoundT", bound=Bound)


class EngineRuntime(Generic[BoundT]):
    """The engine of models that learn together.

    Between :meth:`running` and its end the models' parameters and optimizer states are views of the
    engine's tensors. Callbacks may load parameters, reset optimizers, replace networks or change
    settings meanwhile, so with callbacks the binding is checked before every use; else once.

    Args:
        models: Models that differ only in weights, data and random numbers. Their attribute
            ``compile`` says whether to compile.
        why_unsupported: Returns what about a model the engine does not support, if anything.
        build: Makes an engine of the models; the second argument is whether to compile.
        refuse: Called with a reason when the engine does not support the models.
    """

    def __init__(
        self,
        models: Sequence[Any],
        why_unsupported: Callable[[Any], str | None],
        build: Callable[[Sequence[Any], bool], BoundT],
        refuse: Callable[[str], None],
    ) -> None:
        self.models = models
        self._why_unsupported, self._build = why_unsupported, build
        # Number of updates of the models before their first call of ``learn``, and after this one.
        self._first: int | None = None
        self._last = 0.0
        self._refuse = refuse
        self._engine: BoundT | None = None
        self._running = self._checked = self._refused = False
        self._watched = True

    @property
    def is_running(self) -> bool:
        """Whether the models may be bound."""
        return self._running

    @property
    def is_watched(self) -> bool:
        """Whether callbacks may change the models."""
        return self._watched

    @property
    def compiles(self) -> bool:
        """Whether the models' settings, and the number of planned updates, ask for compiling."""
        wanted = self.models[0].compile
        if wanted != "auto":
            return bool(wanted)
        # Many short calls of ``learn``, with tests in between, repay compiling as a long one does.
        return self._last - (self._first or 0) >= UPDATES_WORTH_COMPILING

    def plan(self, done: int, updates: float) -> None:
        """Note that a call of ``learn`` begins.

        Args:
            done: Number of updates that the models have done.
            updates: Number of updates that it is going to do.
        """
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

    def engine(self) -> BoundT | None:
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
            same = (engine.compiled or not self.compiles) and engine.fits(self.models)
            if same and not engine.synchronize():
                return engine
            if not same:
                self.drop()
        reason = self._why_unsupported(self.models[0])
        if reason is not None:
            self.drop()
            self._refused = True
            self._refuse(reason)
        elif self._engine is None:
            self._engine = self._build(self.models, self.compiles)
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
