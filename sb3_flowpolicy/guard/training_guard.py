"""The training guard: a run with NaN or infinity stops, and returns to its last finite state."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, Protocol

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_flowpolicy.guard.finite import NonFiniteError

# Most failures show up in the losses first. An infinity that a relu or a clamp hides from them is
# found at the next look at everything, which takes about as long as one update of small networks.
UPDATES_BETWEEN_LOOKS = 2000
# Ordinary rewards and observations are far below; worth pointing at when training has failed.
_EXTREME = 1e6
_COLUMNS = ("observations", "actions", "rewards", "next_observations")


class Minibatch(Protocol):
    """What the guard asks of a minibatch: its columns, by the names of SB3's replay buffer."""

    def columns(self, seed: int) -> Mapping[str, np.ndarray]:
        """Return the columns of one seed."""


class TrainingGuard:
    """Checks losses, parameters and optimizers of S agents that are trained in lockstep.

    Before a call of ``train()``, if 2000 updates have passed since it last did so, it checks that
    all parameters and optimizer states are finite, and copies them. After every call it checks the
    losses. If anything is not finite, it restores the copies in all agents and raises
    :class:`NonFiniteError`: the agents can be used and saved.

    Args:
        models: The agents, which have done equally many updates. Besides SB3's attributes they
            need a method ``optimizers()``, which returns their optimizers by name.
        seeds: Their seeds, to be named in messages.

    Example:
        >>> from sb3_flowpolicy import SACFlow
        >>> model = SACFlow("FlowPolicy", "Pendulum-v1")
        >>> _ = model.actor.latent_pi[0].bias.data.fill_(float("inf"))
        >>> TrainingGuard([model]).look()
        Traceback (most recent call last):
        ...
        sb3_flowpolicy.guard.finite.NonFiniteError: actor.latent_pi.0.bias must be finite, got ...
    """

    def __init__(
        self, models: Sequence[OffPolicyAlgorithm], seeds: Sequence[int] | None = None
    ) -> None:
        self.models = models
        self.seeds = seeds
        self.restart()

    def restart(self, resume_from: str | Path | None = None) -> None:
        """Discard the copies, when learning begins; messages name the folder of checkpoints."""
        self.resume_from = resume_from
        self._kept: list[_Snapshot] = []
        self._kept_at, self._due = 0, -1

    def look(self) -> list[_Snapshot]:
        """Copy what training changes, agent by agent, and check that it is finite.

        Raises:
            NonFiniteError: If any of it is not.
        """
        found = [_Snapshot(_training_tensors(model)) for model in self.models]
        for index, snapshot in enumerate(found):
            name = snapshot.find_non_finite()
            if name is not None:
                values = snapshot.tensors()[name]
                value = values[~values.isfinite()][0].item()
                when = f"after {self.models[index]._n_updates} updates"
                self._stop(name, value, index, None, when, {})
        return found

    def before_updates(self) -> None:
        """Check and copy everything, if that is due, as :meth:`look` does."""
        done = self.models[0]._n_updates
        if done >= self._due:
            self._kept = self.look()
            self._kept_at, self._due = done, done + UPDATES_BETWEEN_LOOKS

    def after_updates(
        self,
        names: Sequence[str],
        losses: Sequence[Sequence[float]],
        history: Sequence[th.Tensor] = (),
        batches: Sequence[Minibatch] = (),
    ) -> None:
        """Check the losses of the updates that were just done.

        Args:
            names: Names of the losses.
            losses: Their means over these updates, (len(names), S).
            history: The losses of each update, (len(names), S); empty if not known.
            batches: The minibatches of each update; empty if not known.

        Raises:
            NonFiniteError: If one of them is not finite.
        """
        if math.isfinite(sum(map(sum, losses))):
            return
        for name, values in zip(names, losses, strict=True):
            for index, value in enumerate(values):
                if not math.isfinite(value):
                    self._blame(names, name, value, index, history, batches)

    def _blame(
        self,
        names: Sequence[str],
        name: str,
        value: float,
        index: int,
        history: Sequence[th.Tensor],
        batches: Sequence[Minibatch],
    ) -> NoReturn:
        """Find the first loss that failed, as all losses fail within two updates, and stop."""
        update, when, where = None, "in the last updates", "replay buffer"
        all_losses = th.stack(list(history)) if history else th.empty(0)
        bad = (~all_losses.isfinite()).nonzero()
        if len(bad):
            k, row, index = bad[0].tolist()
            name, value = names[row], all_losses[k, row, index].item()
            update = self.models[index]._n_updates - len(history) + k + 1
            when, where = f"in update {update}", "minibatch"
            columns = batches[k].columns(index)
        else:
            buffer = self.models[index].replay_buffer
            columns = {column: getattr(buffer, column) for column in _COLUMNS}
        summary = {
            column: _summary(values)
            for column, values in columns.items()
            if isinstance(values, np.ndarray) and values.dtype.kind == "f"  # no images
        }
        lines = [f"{column} {_in_words(numbers)}" for column, numbers in summary.items()]
        self._stop(name, value, index, update, f"{when}; {where}: {'; '.join(lines)}", summary)

    def _stop(
        self,
        name: str,
        value: float,
        index: int,
        update: int | None,
        when: str,
        summary: dict[str, dict[str, float]],
    ) -> NoReturn:
        model = self.models[index]
        seed = None if self.seeds is None else self.seeds[index]
        restored = self._restore()
        who = "" if seed is None else f"seed {seed}, "
        message = f"{name} must be finite, got {value} ({who}step {model.num_timesteps}) {when}. "
        if restored is not None:
            message += f"Weights and optimizers are back at update {restored}. "
        if self.resume_from is not None:
            message += f"resume({str(self.resume_from)!r}, env) continues from a checkpoint. "
        message += "Look for extreme rewards and observations, or lower the learning rate"
        raise NonFiniteError(
            message, name, value, model.num_timesteps, update, seed, summary, restored
        )

    @th.no_grad()
    def _restore(self) -> int | None:
        """Restore the copies; return the number of updates before them."""
        if not self._kept:
            return None
        for model, snapshot in zip(self.models, self._kept, strict=True):
            kept = snapshot.tensors()
            for name, tensor in _training_tensors(model).items():
                if name in kept:
                    tensor.copy_(kept[name].view_as(tensor))
                else:  # an optimizer's state, which is created by its first step
                    tensor.zero_()
            model._n_updates = self._kept_at
        return self._kept_at


class _Snapshot:
    """A copy of many tensors, the floats in one, which makes copying and checking fast."""

    def __init__(self, tensors: Mapping[str, th.Tensor]) -> None:
        floats = {name: value for name, value in tensors.items() if value.is_floating_point()}
        self.sizes = {name: tensor.numel() for name, tensor in floats.items()}
        device = next(iter(floats.values())).device
        # torch.optim keeps its counts of steps on the CPU.
        self.flat = th.cat([tensor.flatten().to(device) for tensor in floats.values()])
        # Counts, for example of the steps of a batch renormalization.
        self._others = {name: tensors[name].clone() for name in tensors if name not in floats}

    def tensors(self) -> dict[str, th.Tensor]:
        """Return the copies by name; floats are flat."""
        parts = self.flat.split(list(self.sizes.values()))
        return {**dict(zip(self.sizes, parts, strict=True)), **self._others}

    def find_non_finite(self) -> str | None:
        """Return the name of a tensor that is not finite, None if all are."""
        # A sum takes a twentieth of the time of looking at every number.
        if math.isfinite(self.flat.sum().item()):
            return None
        bad = (name for name, values in self.tensors().items() if not values.isfinite().all())
        return next(bad, None)


def _training_tensors(model: Any) -> dict[str, th.Tensor]:
    """Return everything that an update changes, by name; sharing memory with the model."""
    states: dict[str, th.Tensor] = dict(model.policy.state_dict())
    if model.log_ent_coef is not None:
        states["log_ent_coef"] = model.log_ent_coef.detach()
    for owner, optimizer in model.optimizers().items():
        parameters = [one for group in optimizer.param_groups for one in group["params"]]
        for number, parameter in enumerate(parameters):
            for key, state in optimizer.state.get(parameter, {}).items():
                states[f"{owner}.optimizer.{number}.{key}"] = state
    return {name: state for name, state in states.items() if isinstance(state, th.Tensor)}


def _summary(values: np.ndarray) -> dict[str, float]:
    """Describe a column that has one row per transition."""
    rows = values.reshape(len(values), -1)
    finite = np.isfinite(rows)
    known = rows[finite]
    return {
        "low": float(known.min()) if known.size else float("nan"),
        "high": float(known.max()) if known.size else float("nan"),
        "not_finite": int(rows.size - known.size),
        "row": int(np.where(finite, np.abs(rows), np.inf).max(1).argmax()),
    }


def _in_words(numbers: Mapping[str, float]) -> str:
    low, high, row = numbers["low"], numbers["high"], numbers["row"]
    words = f"{low:.3g} to {high:.3g}"
    if numbers["not_finite"]:
        return f"{words} and {numbers['not_finite']} values not finite, the first in row {row}"
    return f"{words}, extreme in row {row}" if max(-low, high) > _EXTREME else words
