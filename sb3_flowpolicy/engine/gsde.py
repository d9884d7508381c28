"""gSDE for the engine: SB3's actors with state-dependent noise, as functions of given noise."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch.distributions import Normal

from sb3_flowpolicy.distributions.squashed import tanh_ladj


def noise_dim(actor: Any) -> int:
    """Return the number of entries of an exploration matrix."""
    return actor.action_dist.latent_sde_dim * actor.action_dist.action_dim


@th.no_grad()
def set_matrix(actor: Any, noise: th.Tensor) -> None:
    """Let an actor explore with the matrix of given standard normals, (1, H D)."""
    density = actor.action_dist
    std = density.get_std(actor.log_std)
    density.exploration_mat = std * noise.reshape(std.shape)
    density.exploration_matrices = density.exploration_mat.unsqueeze(0)


def action_log_prob(actor: Any, obs: PyTorchObs, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    r"""Sample actions and score them, as SB3's ``action_log_prob`` does with a given matrix.

    .. math:: u = \mu(h) + (\sigma \odot E)^\top h, \qquad
        u_i \sim \mathcal N \Big( \mu_i, \sum_j \sigma_{ji}^2 h_j^2 + \epsilon \Big)

    As in SB3, all observations of a minibatch share the exploration matrix. Unlike there, nothing
    is added inside the logarithm of the Jacobian of tanh, and u is scored itself. SB3 recovers it
    from the rounded action, which in float32 limits it to 8.3, where its gradient ends.

    Args:
        actor: SB3's actor of SAC, or sb3-contrib's of TQC, with ``use_sde=True``.
        obs: Batch of observations.
        noise: Standard normals E, shape (1, H D).

    Returns:
        Squashed actions, (B, D), and their log-probabilities in nats, (B,).

    References:
        Smooth Exploration for Robotic Reinforcement Learning (Raffin et al., 2022).
    """
    mean, log_std, features = actor.get_action_dist_params(obs)
    latent, density = features["latent_sde"], actor.action_dist
    std = density.get_std(log_std)
    # In the parameters' type, as autocast makes the products bfloat16.
    offset = (latent @ (std * noise.reshape(std.shape))).to(log_std)
    variance = (latent.square() @ std.square()).to(log_std) + density.epsilon
    normal = Normal(th.zeros_like(offset), variance.sqrt(), validate_args=False)
    unsquashed = mean + offset
    return unsquashed.tanh(), normal.log_prob(offset).sum(-1) - tanh_ladj(unsquashed)
