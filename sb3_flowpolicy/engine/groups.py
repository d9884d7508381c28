"""Update only as many seeds together as fit the cache."""

from __future__ import annotations

from typing import Any

import torch as th
from torch import nn

# Measured on a core with 2 MiB of second-level cache, batches of 256, ten seeds, two critics:
# networks of 32 units are fastest ten at a time, 64 units five, 128 units two, 256 units one.
BYTES_AT_ONCE = 700_000


def seeds_at_once(critic: Any, n_seeds: int, batch_size: int) -> int:
    """Return how many of S seeds to update together: a divisor of S.

    The widest layer of one seed's critics decides: its activations are the largest tensors of an
    update that BYTES_AT_ONCE was measured with. What a loss needs is not counted, such as the
    differences of all pairs of quantiles in TQC. On a GPU all seeds go together.

    Example:
        >>> from sb3_flowpolicy import SACFlow
        >>> kwargs = dict(net_arch=[128, 128])
        >>> critic = SACFlow("GaussPolicy", "Pendulum-v1", policy_kwargs=kwargs).critic.cpu()
        >>> seeds_at_once(critic, 10, 256), seeds_at_once(critic, 7, 256)
        (2, 1)
    """
    weights = [layer.weight for layer in critic.modules() if isinstance(layer, nn.Linear)]
    if weights[0].device != th.device("cpu"):
        return n_seeds
    widest = max(len(weight) for weight in weights)
    per_seed = widest * len(critic.q_networks) * batch_size * weights[0].element_size()
    fitting = max(1, BYTES_AT_ONCE // per_seed)
    return max(size for size in range(1, n_seeds + 1) if n_seeds % size == 0 and size <= fitting)
