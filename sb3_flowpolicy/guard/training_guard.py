"""The training guard: a run with NaN or infinity stops, and returns to its last finite state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

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
        self._kept: list[dict[str, th.Tensor]] = []
        self._kept_at = 0

    def look(self) -> list[dict[str, th.Tensor]]:
        """Copy what training changes, agent by agent, and check that it is finite.

        Raises:
            NonFiniteError: If any of it is not.
        """
        found = []
        for index, model in enumerate(self.models):
            kept = {name: one.clone() for name, one in _training_tensors(model).items()}
            found.append(kept)
            # A sum takes less time than looking at every number.
            if math.isfinite(sum(float(one.sum()) for one in kept.values())):
                continue
            for name, values in kept.items():
                if not values.isfinite().all():
                    value = values[~values.isfinite()][0].item()
                    self._stop(name, value, index, f"after {model._n_updates} updates")
        return found

    def before_updates(self) -> None:
        """Check and copy everything, if that is due, as :meth:`look` does."""
        done = self.models[0]._n_updates
        if not self._kept or done >= self._kept_at + UPDATES_BETWEEN_LOOKS:
            self._kept, self._kept_at = self.look(), done

    def after_updates(
        self,
        names: Sequence[str],
        losses: Sequence[Sequence[float]],
        history: Sequence[th.Tensor] = (),
        batches: Sequence[Any] = (),
    ) -> None:
        """Check the losses of the updates that were just done.

        Args:
            names: Names of the losses.
            losses: Their means over these updates, (len(names), S).
            history: The losses of each update, (len(names), S); empty if not known.
            batches: The minibatches of each update, with a method ``columns(seed)``; empty if not
                known.

        Raises:
            NonFiniteError: If one of them is not finite.
        """
        if math.isfinite(sum(map(sum, losses))):
            return
        # The first that failed: all losses fail within two updates.
        each = th.stack(list(history)) if history else th.empty(0)
        bad = (~each.isfinite()).nonzero().tolist()
        if bad:
            k, row, index = bad[0]
            value = each[k, row, index].item()
            update = self.models[index]._n_updates - len(history) + k + 1
            when, columns = f"in update {update}; minibatch", batches[k].columns(index)
        else:
            row, index = np.argwhere(~np.isfinite(losses))[0].tolist()
            value, buffer = losses[row][index], self.models[index].replay_buffer
            when = "in the last updates; replay buffer"
            # With optimize_memory_usage there is one column of observations.
            columns = {name: vars(buffer)[name] for name in _COLUMNS if name in vars(buffer)}
        ranges = [
            f"{column} {_range(values)}"
            for column, values in columns.items()
            if isinstance(values, np.ndarray) and values.dtype.kind == "f"  # no images
        ]
        self._stop(names[row], value, index, f"{when}: {'; '.join(ranges)}")

    def _stop(self, name: str, value: float, index: int, when: str) -> NoReturn:
        """Restore the copies, and raise the error."""
        who = "" if self.seeds is None else f"seed {self.seeds[index]}, "
        step = self.models[index].num_timesteps
        message = f"{name} must be finite, got {value} ({who}step {step}) {when}. "
        if self._kept:
            self._restore()
            message += f"Weights and optimizers are back at update {self._kept_at}. "
        if self.resume_from is not None:
            message += f"resume({str(self.resume_from)!r}, env) continues from a checkpoint. "
        message += "Look for extreme rewards and observations, or lower the learning rate"
        raise NonFiniteError(message)

    @th.no_grad()
    def _restore(self) -> None:
        for model, kept in zip(self.models, self._kept, strict=True):
            for name, tensor in _training_tensors(model).items():
                if name in kept:
                    tensor.copy_(kept[name])
                else:  # an optimizer's state, which is created by its first step
                    tensor.zero_()
            model._n_updates = self._kept_at


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


def _range(values: np.ndarray) -> str:
    """Describe a column that has one row per transition: its range, and the row to look at."""
    rows = values.reshape(len(values), -1)
    finite = np.isfinite(rows)
    known = rows[finite] if finite.any() else np.array([np.nan])
    text = f"{known.min():.3g} to {known.max():.3g}"
    row = np.where(finite, np.abs(rows), np.inf).max(1).argmax()
    if not finite.all():
        return f"{text} and {(~finite).sum()} values not finite, the first in row {row}"
    return f"{text}, extreme in row {row}" if np.abs(known).max() > _EXTREME else text
