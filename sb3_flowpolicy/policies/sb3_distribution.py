"""The interface that SB3's code expects of a distribution, for our densities."""

from __future__ import annotations

import torch as th
from stable_baselines3.common.distributions import Distribution

from sb3_flowpolicy.distributions import ActionDistribution
from sb3_flowpolicy.distributions.base import STANDARD_NORMAL_ENTROPY, standard_normal_log_prob

# PPO averages the entropy over a minibatch, so a few samples per observation are enough.
ENTROPY_PAIRS = 2


class ActionDistributionAdapter(Distribution):
    """An :class:`ActionDistribution` as an SB3 ``Distribution``; its one parameter is the context.

    Example:
        >>> import torch as th
        >>> from sb3_flowpolicy.distributions import RealNVP, TanhSquashed
        >>> density = TanhSquashed(RealNVP(action_dim=2, context_dim=3))
        >>> adapter = ActionDistributionAdapter(density)
        >>> adapter.actions_from_params(th.zeros(4, 3), deterministic=True).shape
        torch.Size([4, 2])
    """

    #: Whether an entropy without closed form is estimated.
    estimates_entropy = True

    def __init__(self, density: ActionDistribution) -> None:
        super().__init__()
        self.density = density
        self.context: th.Tensor

    def proba_distribution_net(self) -> ActionDistribution:
        """Return the module that holds the parameters."""
        return self.density

    def proba_distribution(self, context: th.Tensor) -> ActionDistributionAdapter:
        """Condition on ``context``, shape (batch, H)."""
        self.context = context
        return self

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """Score ``actions`` (batch, D): shape (batch,)."""
        return self.density.log_prob(self.context, actions)

    def entropy(self) -> th.Tensor | None:
        """Return the entropy, or an estimate with gradient: shape (batch,).

        Squashed densities and flows have no closed form: see :func:`estimate_entropy`, or None if
        :attr:`estimates_entropy` is False. SB3 then logs the mean of -log p instead.
        """
        exact = self.density.entropy(self.context)
        if exact is not None or not self.estimates_entropy:
            return exact
        noise = self.density.draw_noise(self.context, ENTROPY_PAIRS)
        return estimate_entropy(self.density, self.context, noise)

    def sample(self) -> th.Tensor:
        """Draw a reparametrized sample, shape (batch, D)."""
        return self.density.rsample(self.context, self.density.draw_noise(self.context))

    def mode(self) -> th.Tensor:
        """Return the deterministic action, shape (batch, D)."""
        return self.density.mode(self.context)

    def actions_from_params(self, context: th.Tensor, deterministic: bool = False) -> th.Tensor:
        """Condition on ``context`` and return the mode or a sample, shape (batch, D)."""
        return self.proba_distribution(context).get_actions(deterministic)

    def log_prob_from_params(self, context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Condition on ``context``, sample and score: (batch, D) and (batch,)."""
        self.context = context
        return self.density.rsample_and_log_prob(context, self.density.draw_noise(context))


def estimate_entropy(
    density: ActionDistribution, context: th.Tensor, noise: th.Tensor
) -> th.Tensor:
    """Estimate the entropy in nats (batch,), with gradient, from standard normals (K, batch, M).

    It is that of the noise plus the mean log-determinant. Noise is used with both signs, which
    cancels the terms of the error that are odd in it.
    """
    noise = th.cat([noise, -noise])
    log_prob = density.rsample_and_log_prob(context, noise)[1]
    ladj = standard_normal_log_prob(noise) - log_prob
    return density.noise_dim * STANDARD_NORMAL_ENTROPY + ladj.mean(0)
