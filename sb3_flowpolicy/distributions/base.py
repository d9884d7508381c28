"""The interface of action densities: pure functions of parameters, context and noise."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch as th
from torch import nn

from sb3_flowpolicy.common.validation import integer

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
# Per coordinate, in nats.
STANDARD_NORMAL_ENTROPY = 0.5 + LOG_SQRT_2PI
# Log-densities and gradients fit into float32 up to this many standard deviations from the mean.
FARTHEST = 1e12


class ActionDistribution(nn.Module, ABC):
    r"""Conditional density p(u | h) over unsquashed actions u, given a context h.

    The caller draws the noise, so that the same code runs eagerly, under ``torch.compile``, under
    ``torch.func.vmap`` and in an exported graph, and so that two implementations can be compared
    number by number.

    To add a density, subclass this in one file, set :attr:`noise_dim`, write
    :meth:`_rsample_and_log_prob`, :meth:`_log_prob` and :meth:`_mode`, and call
    :func:`~sb3_flowpolicy.distributions.register_distribution`. The public methods check shapes, so
    a subclass contains only mathematics. Leading dimensions of context and noise broadcast: for
    N samples per context, what depends on the context alone is computed once.

    Args:
        action_dim: Number of action dimensions D, at least 1.
        context_dim: Number of context features H, at least 1.

    Raises:
        ValueError: In the public methods, if the last dimension of a tensor has the wrong size.
    """

    #: Number of standard normals M that one sample consumes.
    noise_dim: int

    def __init__(self, action_dim: int, context_dim: int) -> None:
        super().__init__()
        self.action_dim = integer(1)("action_dim", action_dim)
        self.context_dim = integer(1)("context_dim", context_dim)
        self.noise_dim = self.action_dim

    def rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Turn noise into a reparametrized sample and its log-density in one pass.

        Args:
            context: Features h, shape (..., H).
            noise: Standard normal noise, shape (..., M).

        Returns:
            The sample u, shape (..., D), and log p(u | h) in nats, shape (...).
        """
        _check_last_dim("context", context, self.context_dim)
        _check_last_dim("noise", noise, self.noise_dim)
        return self._rsample_and_log_prob(context, noise)

    def rsample(self, context: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """Return the sample of :meth:`rsample_and_log_prob` without scoring it: to act."""
        _check_last_dim("context", context, self.context_dim)
        _check_last_dim("noise", noise, self.noise_dim)
        return self._rsample(context, noise)

    def log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor:
        """Return log p(u | h) in nats, shape (...), of points ``value``, shape (..., D)."""
        _check_last_dim("context", context, self.context_dim)
        _check_last_dim("value", value, self.action_dim)
        return self._log_prob(context, value)

    def mode(self, context: th.Tensor) -> th.Tensor:
        """Return the sample of zero noise, shape (..., D): for a Gaussian the mean."""
        _check_last_dim("context", context, self.context_dim)
        return self._mode(context)

    def entropy(self, context: th.Tensor) -> th.Tensor | None:
        """Return the entropy in nats, shape (...), or None where it has no closed form."""
        _check_last_dim("context", context, self.context_dim)
        return self._entropy(context)

    def shrink_heads(self) -> None:
        """Reinitialize for on-policy algorithms: the density then hardly depends on the context.

        Weights of the layers that read the context become orthogonal with a small gain, biases
        zero, as in the last layer of SB3's on-policy policies. Override it where another start
        is better.
        """
        for module in self.children():
            if isinstance(module, nn.Linear):
                nn.init.orthogonal_(module.weight, 0.01)
                nn.init.zeros_(module.bias)

    def draw_noise(self, context: th.Tensor, *sample_shape: int) -> th.Tensor:
        """Draw standard normal noise for ``context``, shape (sample_shape, ..., M)."""
        shape = (*sample_shape, *context.shape[:-1], self.noise_dim)
        return th.randn(shape, dtype=context.dtype, device=context.device)

    @abstractmethod
    def _rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]: ...

    def _rsample(self, context: th.Tensor, noise: th.Tensor) -> th.Tensor:
        # To be overridden where the log-density takes a large part of the time.
        return self._rsample_and_log_prob(context, noise)[0]

    @abstractmethod
    def _log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor: ...

    @abstractmethod
    def _mode(self, context: th.Tensor) -> th.Tensor: ...

    def _entropy(self, context: th.Tensor) -> th.Tensor | None:
        return None


def standard_normal_log_prob(noise: th.Tensor) -> th.Tensor:
    """Log-density of a standard normal, summed over the last dimension: (..., M) -> (...)."""
    return -(0.5 * noise.square() + LOG_SQRT_2PI).sum(-1)


def score_standard_normal(point: th.Tensor) -> th.Tensor:
    """Log-density at a given point, whose coordinates are clipped so that it stays finite."""
    return standard_normal_log_prob(point.clamp(-FARTHEST, FARTHEST))


def soft_bound(value: th.Tensor, bound: float | th.Tensor) -> th.Tensor:
    """Squeeze into (-bound, bound): slope 1 at zero and, unlike a clip, a gradient everywhere."""
    return value / (1 + value.abs() / bound)


def _check_last_dim(name: str, tensor: th.Tensor, expected: int) -> None:
    if tensor.ndim == 0 or tensor.shape[-1] != expected:
        raise ValueError(f"{name} must have shape (..., {expected}), got {tuple(tensor.shape)}")
