"""TQC: quantiles of the return, of which the targets leave out the largest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch as th
from sb3_contrib.tqc.policies import Actor, Critic
from torch import nn

from sb3_flowpolicy.engine.update import Objective


@dataclass(frozen=True)
class TQCObjective(Objective):
    r"""The :class:`~sb3_flowpolicy.engine.update.Objective` of TQC: N quantiles per critic.

    V' are the smallest quantiles of all C critics together, V the mean of all, and the loss is

    .. math::
        L_Q = \mathrm{mean}_{c, i, j} |\tau_i - 1[y_j < \theta_{ci}]| H(y_j - \theta_{ci}),
        \qquad \tau_i = (i + 1/2) / N

    with Huber's function H.

    Args:
        dropped: Number of largest quantiles that the targets leave out, per critic.

    References:
        Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
        Critics (Kuznetsov et al., 2020).
    """

    dropped: int
    name: ClassVar[str] = "TQC"
    critic_type: ClassVar[type[nn.Module]] = Critic
    gsde_actor_type: ClassVar[type[nn.Module] | None] = Actor

    def next_values(self, outputs: th.Tensor) -> th.Tensor:
        """Return the smallest C (N - dropped) quantiles of the target critics, (S, B, T)."""
        n_critics, n_quantiles = outputs.shape[1], outputs.shape[3]
        together = outputs.transpose(1, 2).flatten(2)
        kept = n_critics * (n_quantiles - self.dropped)
        # Their order does not matter, and sorting takes twice as long.
        return together.topk(kept, largest=False, sorted=False).values

    def critic_loss(self, outputs: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """Return the quantile Huber loss, (S,)."""
        n_quantiles = outputs.shape[3]
        # In float32 for networks of any type, as in sb3-contrib.
        levels = (th.arange(n_quantiles, device=outputs.device) + 0.5) / n_quantiles
        levels = levels.unsqueeze(-1)
        errors = targets[:, None, :, None, :] - outputs.unsqueeze(-1)
        weights = th.where(errors.detach() < 0, 1 - levels, levels)
        size = errors.abs()
        clipped = size.clamp(max=1)
        huber = clipped * (size - clipped / 2)
        return (weights * huber).mean((1, 2, 3, 4))

    def actor_values(self, outputs: th.Tensor) -> th.Tensor:
        """Return the mean of all quantiles, (S, B)."""
        return outputs.mean((1, 3))
