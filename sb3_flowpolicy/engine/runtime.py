"""Binds models to an engine for as long as they learn."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

import torch as th
from torch import nn

from sb3_flowpolicy.engine.adam import FlatAdam, adam_settings
from sb3_flowpolicy.engine.arithmetic import flushed_subnormals, threads_for
from sb3_flowpolicy.engine.flat import FlatParameters

# Compiling pays after 1800 to 5000 updates, depending on width, density, and the number of seeds
# (docs/engine.md).
UPDATES_WORTH_COMPILING = 5000
# Layers that behave differently in training, or draw random numbers of their own.
_MODE_DEPENDENT = (nn.modules.batchnorm._BatchNorm, nn.modules.dropout._DropoutNd, nn.RReLU)
# A dictionary, such as an object's ``__dict__``, and a key.
Place = tuple[Mapping[str, Any], str]


class BoundEngine(ABC):
    """Updates models whose parameters and optimizer states are views of its tensors.

    Args:
        models: Models that differ in nothing but weights, data and random numbers.
        compiled: Whether to compile. Where no compiler works, everything runs eagerly, with one
            warning and the same numbers.
    """

    #: Everything that is bound.
    parts: list[FlatParameters | FlatAdam]
    #: Those of them that acting reads.
    acting_parts: list[FlatParameters]

    def __init__(self, models: Sequence[Any], compiled: bool = False) -> None:
        self.models = list(models)
        self.compiled = compiled
        self.settings = self.settings_of(self.models[0])
        self._things: list[tuple[Mapping[str, Any], str, Any, object]] = []

    @staticmethod
    @abstractmethod
    def why_unsupported(model: Any) -> str | None:
        """Return which part of a model the engine does not support, or None."""

    @staticmethod
    @abstractmethod
    def settings_of(model: Any) -> Any:
        """Return the constants of a model's update, which are compiled into it."""

    def fits(self) -> bool:
        """Whether the models have the same networks, optimizers and constants as at the start."""
        return self._has_same_things() and self.settings == self.settings_of(self.models[0])

    def _note(self, places: Sequence[Place]) -> None:
        """Note what is bound: objects by where they are, and tensors also by type and device."""
        self._things = [(home, name, home[name], _kind(home[name])) for home, name in places]

    def _has_same_things(self) -> bool:
        """Whether none of what was noted was replaced, frozen or moved."""
        for home, name, thing, kind in self._things:
            if home[name] is not thing or _kind(thing) != kind:
                return False
        return True

    def acts_as_now(self) -> bool:
        """Whether everything that acting reads is still bound."""
        return self._has_same_things() and all(part.is_bound() for part in self.acting_parts)

    def synchronize(self) -> bool:
        """Take over what was loaded or moved since the last update; return whether anything was."""
        if all(part.is_bound() for part in self.parts):
            return False
        for part in self.parts:
            part.bind()
        return True

    def release(self) -> None:
        """Give modules and optimizers memory of their own, until :meth:`synchronize`."""
        for part in self.parts:
            part.release()


def _kind(thing: Any) -> object:
    return isinstance(thing, th.Tensor) and (thing.requires_grad, thing.dtype, thing.device)


def why_network_unsupported(network: Any) -> str | None:
    """Return what about a network and its optimizer no engine supports, None if nothing."""
    for module in network.modules():
        if isinstance(module, _MODE_DEPENDENT):
            return f"layer of type {type(module).__name__}"
    for parameter in network.parameters():
        if not parameter.requires_grad or parameter._backward_hooks:
            return "parameters that are frozen or have hooks"
    optimizer = network.optimizer
    if adam_settings(optimizer) is None:
        return f"optimizer of type {type(optimizer).__name__} with these settings"
    if optimizer._optimizer_step_pre_hooks or optimizer._optimizer_step_post_hooks:
        return "optimizer with hooks"
    owners = optimizer.param_groups[0]["params"]
    if set(map(id, owners)) != set(map(id, network.parameters())):
        return "optimizer of other parameters than the network's"
    if len({float(optimizer.state.get(owner, {}).get("step", 0)) for owner in owners}) > 1:
        return "optimizer of which a part was reset"
    return None


EngineT = TypeVar("EngineT", bound=BoundEngine)


class EngineRuntime(Generic[EngineT]):
    """Provides the engine of models that learn together.

    Between :meth:`running` and its end the models' parameters and optimizer states are views of the
    engine's tensors. Callbacks may load parameters, reset optimizers, replace networks or change
    settings meanwhile, so with callbacks the binding is checked before every use; else once.

    Args:
        models: Models that differ only in weights, data and random numbers. Their attribute
            ``compile`` says whether to compile.
        engine_class: Class of the engine.
        refuse: Called with a reason when the engine does not support the models.
    """

    def __init__(
        self, models: Sequence[Any], engine_class: type[EngineT], refuse: Callable[[str], None]
    ) -> None:
        self.models = models
        #: Whether the models may be bound.
        self.is_running = False
        #: Whether callbacks may change the models.
        self.is_watched = True
        self._class, self._refuse = engine_class, refuse
        # Number of updates of the models before their first call of ``learn``, and after this one.
        self._first: int | None = None
        self._last = 0.0
        self._engine: EngineT | None = None
        self._checked = self._refused = False

    @property
    def compiles(self) -> bool:
        """Whether to compile, by the models' settings and the number of planned updates."""
        wanted = self.models[0].compile
        if wanted != "auto":
            return bool(wanted)
        # Many short calls of ``learn``, with tests in between, repay compiling as a long one does.
        return self._last - (self._first or 0) >= UPDATES_WORTH_COMPILING

    def plan(self, done: int, updates: float) -> None:
        """Note that a call of ``learn`` begins, after so many updates and with so many to come."""
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
        if self.is_running:
            yield
            return
        first = self.models[0]
        size = sum(parameter.numel() for parameter in first.policy.parameters())
        self.is_running, self.is_watched = True, watched
        self._checked = self._refused = False
        try:
            with threads_for(size * first.batch_size), flushed_subnormals():
                yield
        finally:
            self.is_running = False
            if self._engine is not None:
                self._engine.release()

    def engine(self) -> EngineT | None:
        """Return the engine, bound to the models as they are now; None if it does not support them.

        To be called within :meth:`running`.
        """
        if self._checked and not self.is_watched:
            return self._engine
        self._checked = True
        if self._refused:
            return None
        if self._engine is not None:
            # What was compiled once is kept: eager updates would be slower.
            same = (self._engine.compiled or not self.compiles) and self._engine.fits()
            if same and not self._engine.synchronize():
                return self._engine
            if not same:
                self._drop()
        reason = self._class.why_unsupported(self.models[0])
        if reason is not None:
            self._drop()
            self._refused = True
            self._refuse(reason)
        elif self._engine is None:
            self._engine = self._class(self.models, self.compiles)
        return self._engine

    def acting_engine(self) -> EngineT | None:
        """Return what :meth:`engine` does, but check only what acting reads.

        Checking the critics and the optimizers, too, would take half as long as acting.
        """
        engine = self._engine
        if self.is_watched and engine is not None and engine.acts_as_now():
            return engine
        return self.engine()

    def _drop(self) -> None:
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
