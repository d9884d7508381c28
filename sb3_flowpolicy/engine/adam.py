"""Adam and AdamW as one function of flat tensors, sharing their state with ``torch.optim``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch as th

from sb3_flowpolicy.engine.flat import FlatParameters


@dataclass(frozen=True)
class AdamSettings:
    """Hyperparameters of Adam or AdamW, without the learning rate."""

    beta1: float
    beta2: float
    eps: float
    weight_decay: float
    decoupled: bool


def adam_settings(optimizer: th.optim.Optimizer | None) -> AdamSettings | None:
    """Return the settings of a plain Adam or AdamW, None for any other optimizer."""
    if optimizer is None or type(optimizer) not in (th.optim.Adam, th.optim.AdamW):
        return None
    group, *others = optimizer.param_groups
    decay = group["weight_decay"]
    if others or group["amsgrad"] or group["maximize"] or not isinstance(decay, float | int):
        return None
    beta1, beta2 = group["betas"]
    return AdamSettings(beta1, beta2, group["eps"], decay, type(optimizer) is th.optim.AdamW)


# Names of an optimizer's own entries.
_KEYS = ("step", "exp_avg", "exp_avg_sq")


class Moments(NamedTuple):
    """State of S Adams."""

    mean: th.Tensor  # first moments, (S, P)
    square: th.Tensor  # second moments, (S, P)
    step: th.Tensor  # steps taken so far, (S, number of parameters): one each, as in torch.optim


class FlatAdam:
    """Moments of S optimizers as tensors (S, P); the optimizers' own states become views."""

    def __init__(self, flat: FlatParameters, optimizers: list[th.optim.Optimizer]) -> None:
        self.flat = flat
        self.optimizers = optimizers
        self.bind()

    def bind(self) -> None:
        """Take over the optimizers' states and make them views of ours."""
        data = self.flat.data
        steps = th.zeros(len(data), len(self.flat.views(data, 0)), device=data.device)
        self.moments = Moments(th.zeros_like(data), th.zeros_like(data), steps)
        self._bound = []
        for seed, optimizer in enumerate(self.optimizers):
            entries = []
            means, squares = (self.flat.views(part, seed) for part in self.moments[:2])
            for (owner, mean), (_, square), step in zip(means, squares, steps[seed], strict=True):
                entries.append((owner, mean, square))
                state = optimizer.state[owner]
                for key, view in zip(_KEYS, (step, mean, square), strict=True):
                    if key in state:
                        view.copy_(state[key])
                    state[key] = view
            self._bound.append((optimizer, optimizer.state, entries))

    def is_bound(self) -> bool:
        """Whether the optimizers' states are still views: loading or resetting one undoes it."""
        for optimizer, state, entries in self._bound:
            if optimizer.state is not state or len(state) != len(entries):
                return False
            for owner, mean, square in entries:
                entry = state.get(owner, {})
                if entry.get("exp_avg") is not mean or entry.get("exp_avg_sq") is not square:
                    return False
        return True

    def release(self) -> None:
        """Give the optimizers memory of their own again."""
        for optimizer in self.optimizers:
            for state in optimizer.state.values():
                state.update({key: state[key].clone() for key in _KEYS if key in state})


def adam_step(
    parameters: th.Tensor,
    gradient: th.Tensor,
    moments: Moments,
    learning_rate: th.Tensor,
    settings: AdamSettings,
) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
    """One step of Adam, or AdamW, as torch computes it, for flat parameters (S, P).

    The learning rate is 0-dimensional, in float64.

    Returns:
        New parameters and moments.

    References:
        Adam (Kingma and Ba, 2015); Decoupled Weight Decay Regularization (Loshchilov and Hutter,
        2019).
    """
    mean, square, step = moments.mean, moments.square, moments.step + 1
    # float64, because 1 - 0.999^t needs its digits.
    count = step[:, :1].double()
    dtype = parameters.dtype
    if settings.weight_decay and settings.decoupled:
        parameters = parameters * (1 - learning_rate * settings.weight_decay).to(dtype)
    elif settings.weight_decay:
        gradient = gradient + settings.weight_decay * parameters
    mean = mean + (1 - settings.beta1) * (gradient - mean)
    square = settings.beta2 * square + (1 - settings.beta2) * gradient * gradient
    step_size = (learning_rate / (1 - settings.beta1**count)).to(dtype)
    correction = (1 - settings.beta2**count).sqrt().to(dtype)
    parameters = parameters - step_size * mean / (square.sqrt() / correction + settings.eps)
    return parameters, mean, square, step
