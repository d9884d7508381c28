"""Adam and AdamW as one function of flat tensors, sharing their state with ``torch.optim``."""

from __future__ import annotations

from dataclasses import dataclass

import torch as th

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
    """Return the settings of a plain Adam or AdamW, None for any other optimizer."""
    if type(optimizer) not in (th.optim.Adam, th.optim.AdamW) or len(optimizer.param_groups) != 1:
        return None
    group = optimizer.param_groups[0]
    if group["amsgrad"] or group["maximize"] or not isinstance(group["weight_decay"], float | int):
        return None
    beta1, beta2 = group["betas"]
    decoupled = type(optimizer) is th.optim.AdamW
    return AdamSettings(beta1, beta2, group["eps"], group["weight_decay"], decoupled)


def why_optimizer_unsupported(optimizer: th.optim.Optimizer, network: th.nn.Module) -> str | None:
    """Return what about a network's optimizer the engines do not support, None if nothing."""
    if adam_settings(optimizer) is None:
        return f"optimizer of type {type(optimizer).__name__} with these settings"
    if optimizer._optimizer_step_pre_hooks or optimizer._optimizer_step_post_hooks:
        return "optimizer with hooks"
    owners = optimizer.param_groups[0]["params"]
    if set(map(id, owners)) != set(map(id, network.parameters())):
        return "optimizer of other parameters than the network's"
    states = [optimizer.state.get(owner, {}) for owner in owners]
    if len({float(state.get("step", 0)) for state in states}) > 1:
        return "optimizer of which a part was reset"
    return None


class FlatAdam:
    """Moments of S optimizers as tensors (S, P); the optimizers' own states become views.

    Args:
        flat: The parameters.
        optimizers: One Adam or AdamW per seed, over exactly these parameters.
    """

    def __init__(self, flat: FlatParameters, optimizers: list[th.optim.Optimizer]) -> None:
        settings = adam_settings(optimizers[0])
        assert settings is not None
        self.settings = settings
        self.flat = flat
        self.optimizers = optimizers
        self.bind()

    def bind(self) -> None:
        """Take over the optimizers' states and make them views of ours."""
        data = self.flat.data
        self.mean, self.square = th.zeros_like(data), th.zeros_like(data)
        # One count per parameter, as in torch.optim, although they never differ.
        n_owners = len(self.flat.views(data, 0))
        self.step = th.zeros(len(data), n_owners, device=data.device)
        self._bound = []
        for seed, optimizer in enumerate(self.optimizers):
            entries = []
            pairs = self.flat.views(self.mean, seed), self.flat.views(self.square, seed)
            for step, (owner, mean), (_, square) in zip(self.step[seed], *pairs, strict=True):
                entries.append((owner, mean, square))
                state = optimizer.state[owner]
                if state:
                    step.copy_(state["step"])
                    mean.copy_(state["exp_avg"])
                    square.copy_(state["exp_avg_sq"])
                state.update(step=step, exp_avg=mean, exp_avg_sq=square)
            self._bound.append((optimizer, optimizer.state, entries))

    def is_bound(self) -> bool:
        """Whether the optimizers' states are still views: loading or resetting one undoes it."""
        for optimizer, state, entries in self._bound:
            if optimizer.state is not state or len(state) != len(entries):
                return False
            for owner, mean, square in entries:
                entry = state.get(owner)
                if entry is None or entry.get("exp_avg") is not mean:
                    return False
                if entry.get("exp_avg_sq") is not square:
                    return False
        return True

    def release(self) -> None:
        """Give the optimizers memory of their own again."""
        for optimizer in self.optimizers:
            for state in optimizer.state.values():
                for key in ("step", "exp_avg", "exp_avg_sq"):
                    if key in state:
                        state[key] = state[key].clone()


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
        step: Steps taken so far, (S, number of parameters), all the same.
        learning_rate: Learning rate, 0-dimensional, float64.
        settings: Betas, epsilon and weight decay.

    Returns:
        New parameters, first moments, second moments and step counts.

    References:
        Adam (Kingma and Ba, 2015); Decoupled Weight Decay Regularization (Loshchilov and Hutter,
        2019).
    """
    step = step + 1
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
