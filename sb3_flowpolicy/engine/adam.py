"""Adam and AdamW as one function of flat tensors, sharing their state with ``torch.optim``."""

from __future__ import annotations

from dataclasses import dataclass

import torch as th
from torch.utils.hooks import RemovableHandle

from sb3_flowpolicy.engine.flat import FlatParameters


@dataclass(frozen=True)
class AdamSettings:
    """What distinguishes one Adam from another, apart from the learning rate."""

    beta1: float
    beta2: float
    eps: float
    weight_decay: float
    decoupled: bool


def adam_settings(optimizer: th.optim.Optimizer) -> AdamSettings | None:
    """Return the settings of an Adam or AdamW that we can take over, None for any other."""
    if type(optimizer) not in (th.optim.Adam, th.optim.AdamW) or len(optimizer.param_groups) != 1:
        return None
    group = optimizer.param_groups[0]
    if group["amsgrad"] or group["maximize"] or not isinstance(group["weight_decay"], float | int):
        return None
    beta1, beta2 = group["betas"]
    decoupled = type(optimizer) is th.optim.AdamW
    return AdamSettings(beta1, beta2, group["eps"], group["weight_decay"], decoupled)


class FlatAdam:
    """Moments of S optimisers as tensors (S, P); the optimisers' own states become views.

    Args:
        flat: The parameters.
        optimizers: One Adam or AdamW per seed, over exactly these parameters.
    """

    def __init__(self, flat: FlatParameters, optimizers: list[th.optim.Optimizer]) -> None:
        settings = adam_settings(optimizers[0])
        if settings is None:
            raise ValueError(f"optimizers must be plain Adam or AdamW, got {optimizers[0]!r}")
        self.settings = settings
        self.flat = flat
        self.optimizers = optimizers
        self._hooks: list[RemovableHandle] = []
        self._addresses: list[tuple[th.optim.Optimizer, th.Tensor, int]] = []
        self.bind()

    def bind(self) -> None:
        """Take over the optimisers' states and make them views of ours."""
        self.release()
        # Whoever saves a checkpoint gets step counts that are up to date.
        self._hooks = [
            optimizer.register_state_dict_pre_hook(lambda _: self.publish_steps())
            for optimizer in self.optimizers
        ]
        data = self.flat.data
        self.mean, self.square = th.zeros_like(data), th.zeros_like(data)
        #: Number of steps taken, (S, 1): float64, as 1 - 0.999^t needs its digits.
        self.step = th.zeros(len(data), 1, dtype=th.float64, device=data.device)
        self._addresses = []
        for seed, optimizer in enumerate(self.optimizers):
            pairs = zip(
                self.flat.views(self.mean, seed), self.flat.views(self.square, seed), strict=True
            )
            for (owner, mean), (_, square) in pairs:
                state = optimizer.state[owner]
                if state:
                    mean.copy_(state["exp_avg"])
                    square.copy_(state["exp_avg_sq"])
                    self.step[seed] = float(state["step"])
                state.update(step=th.tensor(0.0), exp_avg=mean, exp_avg_sq=square)
                self._addresses.append((optimizer, owner, mean.data_ptr()))

    def is_bound(self) -> bool:
        """Whether the optimisers' states still are views: loading a checkpoint undoes it."""
        return bool(self._addresses) and all(
            owner in optimizer.state and optimizer.state[owner]["exp_avg"].data_ptr() == address
            for optimizer, owner, address in self._addresses
        )

    def publish_steps(self) -> None:
        """Write the step counts where ``torch.optim`` keeps them: one small tensor each."""
        if not self.is_bound():
            return  # what was loaded since is newer than what we know
        for optimizer, step in zip(self.optimizers, self.step[:, 0].tolist(), strict=True):
            for state in optimizer.state.values():
                state["step"].fill_(step)

    def release(self) -> None:
        """Give the optimisers memory of their own again."""
        self.publish_steps()
        for hook in self._hooks:
            hook.remove()
        for optimizer, owner, _ in self._addresses:
            state = optimizer.state[owner]
            for key in ("exp_avg", "exp_avg_sq"):
                if key in state:
                    state[key] = state[key].clone()
        self._hooks, self._addresses = [], []


def adam_step(
    parameters: th.Tensor,
    gradient: th.Tensor,
    mean: th.Tensor,
    square: th.Tensor,
    step: th.Tensor,
    learning_rate: th.Tensor,
    settings: AdamSettings,
) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
    """One step of Adam, or AdamW, as torch computes it.

    Args:
        parameters: Flat parameters, (S, P).
        gradient: Their gradient, (S, P).
        mean: First moments, (S, P).
        square: Second moments, (S, P).
        step: Steps taken so far, (S, 1), float64.
        learning_rate: Learning rate, 0-dimensional, float64.
        settings: Betas, epsilon and weight decay.

    Returns:
        New parameters, first moments, second moments and step counts.

    References:
        Adam (Kingma and Ba, 2015); Decoupled Weight Decay Regularization (Loshchilov and Hutter,
        2019).
    """
    step = step + 1
    dtype = parameters.dtype
    if settings.weight_decay and settings.decoupled:
        parameters = parameters * (1 - learning_rate * settings.weight_decay).to(dtype)
    elif settings.weight_decay:
        gradient = gradient + settings.weight_decay * parameters
    mean = mean + (1 - settings.beta1) * (gradient - mean)
    square = settings.beta2 * square + (1 - settings.beta2) * gradient * gradient
    step_size = (learning_rate / (1 - settings.beta1**step)).to(dtype)
    correction = (1 - settings.beta2**step).sqrt().to(dtype)
    parameters = parameters - step_size * mean / (square.sqrt() / correction + settings.eps)
    return parameters, mean, square, step
