"""Our densities behind the interface that SB3's own code expects of a distribution."""

from __future__ import annotations

import torch as th
from stable_baselines3.common.distributions import Distribution

from sb3_flowpolicy.distributions import ActionDistribution

# PPO asks for the entropy of whole minibatches, over which the estimate's noise averages out.
ENTROPY_PAIRS = 2


class ActionDistributionAdapter(Distribution):
    """An :class:`ActionDistribution` as an SB3 ``Distribution``; its one parameter is the context.

    Args:
        density: The density, usually squashed; its weights stay its own.

    Example:
        >>> import torch as th
        >>> from sb3_flowpolicy.distributions import RealNVP, TanhSquashed
        >>> density = TanhSquashed(RealNVP(action_dim=2, context_dim=3))
        >>> adapter = ActionDistributionAdapter(density)
        >>> adapter.actions_from_params(th.zeros(4, 3), deterministic=True).shape
        torch.Size([4, 2])
    """

    def __init__(self, density: ActionDistribution) -> None:
        super().__init__()
        self.density = density
        self.context: th.Tensor | None = None

    def proba_distribution_net(self) -> ActionDistribution:
        """Return the module that holds the parameters."""
        return self.density

    def proba_distribution(self, context: th.Tensor) -> ActionDistributionAdapter:
        """Condition on ``context``, shape (batch, H)."""
        self.context = context
        return self

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """Score ``actions`` (batch, D): shape (batch,)."""
        return self.density.log_prob(self._conditioned(), actions)

    def entropy(self) -> th.Tensor:
        """Estimate the entropy by Monte Carlo, with gradient: shape (batch,).

        There is no closed form for squashed or bent densities. Noise comes in pairs of opposite
        sign, so that what is odd in it cancels.
        """
        context = self._conditioned()
        noise = self._draw_noise(ENTROPY_PAIRS)
        noise = th.cat([noise, -noise])
        return -self.density.rsample_and_log_prob(context, noise)[1].mean(0)

    def sample(self) -> th.Tensor:
        """Draw a reparametrised sample, shape (batch, D)."""
        return self._sample_and_log_prob()[0]

    def mode(self) -> th.Tensor:
        """Return the deterministic action, shape (batch, D)."""
        return self.density.mode(self._conditioned())

    def actions_from_params(self, context: th.Tensor, deterministic: bool = False) -> th.Tensor:
        """Condition on ``context`` and return the mode or a sample, shape (batch, D)."""
        return self.proba_distribution(context).get_actions(deterministic)

    def log_prob_from_params(self, context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Condition on ``context``, sample and score: (batch, D) and (batch,)."""
        return self.proba_distribution(context)._sample_and_log_prob()

    def _sample_and_log_prob(self) -> tuple[th.Tensor, th.Tensor]:
        return self.density.rsample_and_log_prob(self._conditioned(), self._draw_noise())

    def _draw_noise(self, *sample_shape: int) -> th.Tensor:
        context = self._conditioned()
        shape = (*sample_shape, *context.shape[:-1], self.density.noise_dim)
        return th.randn(shape, dtype=context.dtype, device=context.device)

    def _conditioned(self) -> th.Tensor:
        if self.context is None:
            raise ValueError("context must be set by proba_distribution() first, got None")
        return self.context
