"""The training guard: no run goes on with NaN, and none ends with it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_flowpolicy.guard.finite import NonFiniteError

# Losses tell of most mischief at once. An infinity that a relu or a clamp hides from them is found
# at the next look at everything, which takes about as long as one update of small networks.
UPDATES_BETWEEN_LOOKS = 2000
# Ordinary rewards and observations are far below; worth pointing at when training has failed.
_EXTREME = 1e6
# Name in messages -> field of the engine's minibatch, attribute of SB3's replay buffer.
_COLUMNS = {
    "observations": ("obs", "observations"),
    "actions": ("actions", "actions"),
    "rewards": ("rewards", "rewards"),
    "next_observations": ("next_obs", "next_observations"),
}


class TrainingGuard:
    """Watches losses, parameters and optimisers of S agents that are trained in lockstep.

    Every 2000th update it makes sure that all parameters and optimiser states are finite, and
    remembers them. After every call of ``train()`` it looks at the losses. If anything is not
    finite it puts back what it remembers, in all agents, and raises :class:`NonFiniteError`: the
    agents are left as they were at most 2000 updates before, and can be used and saved.

    Args:
        models: The agents, of SAC or an algorithm that descends from it, equally many updates old.
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
        #: Folder of the checkpoints that are being written, to be named in messages.
        self.resume_from: str | Path | None = None
        self.restart()

    def restart(self) -> None:
        """Forget what was remembered: the next weights may not be those of the last update."""
        self._kept: list[_Snapshot] = []
        self._kept_at, self._due = 0, -1

    def look(self) -> list[_Snapshot]:
        """Return what training changes, agent by agent, after making sure that it is finite.

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
        """Look at everything and remember it, if that is due.

        Raises:
            NonFiniteError: If any of it is not finite.
        """
        done = self.models[0]._n_updates
        if done >= self._due:
            self._kept = self.look()
            self._kept_at, self._due = done, done + UPDATES_BETWEEN_LOOKS

    def after_updates(
        self,
        names: Sequence[str],
        losses: Sequence[Sequence[float]],
        history: Sequence[th.Tensor] = (),
        batches: Sequence[Any] = (),
    ) -> None:
        """Look at the losses of the updates that were just done.

        Args:
            names: Names of the losses.
            losses: Their means over these updates, (len(names), S).
            history: The losses of each update, (len(names), S); nothing where not known.
            batches: The minibatches of each update (``engine.update.Batch``).

        Raises:
            NonFiniteError: If one of them is not finite.
        """
        if math.isfinite(sum(map(sum, losses))):  # asked after every update: in one go
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
        batches: Sequence[Any],
    ) -> NoReturn:
        """Find out where it began, for it spreads to all losses within two updates, and stop."""
        update, when, where = None, "in the last updates", "replay buffer"
        all_losses = th.stack(list(history)) if history else th.empty(0)
        bad = (~all_losses.isfinite()).nonzero()
        if len(bad):
            k, row, index = bad[0].tolist()
            name, value = names[row], all_losses[k, row, index].item()
            update = self.models[index]._n_updates - len(history) + k + 1
            when, where = f"in update {update}", "minibatch"
            columns = {
                column: getattr(batches[k], field)[index].detach().cpu().numpy()
                for column, (field, _) in _COLUMNS.items()
            }
        else:
            buffer = self.models[index].replay_buffer
            columns = {column: getattr(buffer, name) for column, (_, name) in _COLUMNS.items()}
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
            message += f"resume({str(self.resume_from)!r}, env) goes on from the last checkpoint. "
        message += "Look for extreme rewards and observations, or lower the learning rate"
        raise NonFiniteError(
            message, name, value, model.num_timesteps, update, seed, summary, restored
        )

    @th.no_grad()
    def _restore(self) -> int | None:
        """Put back what was remembered; return how many updates that had seen."""
        if not self._kept:
            return None
        for model, snapshot in zip(self.models, self._kept, strict=True):
            kept = snapshot.tensors()
            for name, tensor in _training_tensors(model).items():
                if name in kept:
                    tensor.copy_(kept[name].view_as(tensor))
                else:  # an optimiser's state, which begins to exist with its first step
                    tensor.zero_()
            model._n_updates = self._kept_at
        return self._kept_at


class _Snapshot:
    """A copy of many tensors in one: copied and looked at in one go."""

    def __init__(self, tensors: Mapping[str, th.Tensor]) -> None:
        self.sizes = {name: tensor.numel() for name, tensor in tensors.items()}
        device = next(iter(tensors.values())).device
        # torch.optim keeps its counts of steps on the CPU.
        self.flat = th.cat([tensor.flatten().to(device) for tensor in tensors.values()])

    def tensors(self) -> dict[str, th.Tensor]:
        """Return the copies by name, flat."""
        return dict(zip(self.sizes, self.flat.split(list(self.sizes.values())), strict=True))

    def find_non_finite(self) -> str | None:
        """Return the name of a tensor that is not finite, None if all are."""
        # A sum takes a twentieth of the time; only if it is not finite, why?
        if math.isfinite(self.flat.sum().item()):
            return None
        bad = (name for name, values in self.tensors().items() if not values.isfinite().all())
        return next(bad, None)


def _training_tensors(model: Any) -> dict[str, th.Tensor]:
    """Everything that an update changes, by name; sharing memory with the model."""
    states: dict[str, th.Tensor] = dict(model.policy.state_dict())
    if model.log_ent_coef is not None:
        states["log_ent_coef"] = model.log_ent_coef.detach()
    optimizers = {
        "actor": model.actor.optimizer,
        "critic": model.critic.optimizer,
        "ent_coef": model.ent_coef_optimizer,
    }
    for owner, optimizer in optimizers.items():
        groups = [] if optimizer is None else optimizer.param_groups
        parameters = [parameter for group in groups for parameter in group["params"]]
        for number, parameter in enumerate(parameters):
            for key, state in optimizer.state.get(parameter, {}).items():
                states[f"{owner}.optimizer.{number}.{key}"] = state
    return {
        name: state
        for name, state in states.items()
        if isinstance(state, th.Tensor) and state.is_floating_point()
    }


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
