"""The same model of many seeds, trained and scored in one go."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from torch.func import functional_call, stack_module_state, vmap

from sb3_flowpolicy.density.models import FlowModel, make_model

# Parameter name -> the values of all S copies, (S, *shape).
Weights = dict[str, th.Tensor]


class Ensemble:
    """S copies of a model that differ in their weights only.

    Stacked along a leading axis, ten small networks cost far less than ten times one. Models that
    ``vmap`` cannot stack are evaluated one after the other, with the same result.

    Args:
        name: Name of the model.
        condition_dim: Number C of conditioning variables.
        seeds: One seed per copy.

    Example:
        >>> import torch as th
        >>> ensemble = Ensemble("realnvp", condition_dim=0, seeds=[0, 1, 2])
        >>> ensemble.log_prob(th.zeros(3, 7, 2), th.zeros(3, 7, 0)).shape
        torch.Size([3, 7])
    """

    def __init__(self, name: str, condition_dim: int, seeds: Sequence[int]) -> None:
        self.name, self.condition_dim, self.seeds = name, condition_dim, list(seeds)
        models = [make_model(name, condition_dim, seed) for seed in seeds]
        self._template = models[0]
        self.weights: Weights = stack_module_state(models)[0]
        # Masks and the like. Where they are the same for all they stay single: zuko's couplings
        # index by theirs, which does not stack.
        each = [dict(model.named_buffers()) for model in models]
        stacks = {key: th.stack([one[key] for one in each]) for key in each[0]}
        self._own = {key: value for key, value in stacks.items() if (value != value[:1]).any()}
        self._shared = {key: value for key, value in each[0].items() if key not in self._own}

    def log_prob(self, points: th.Tensor, condition: th.Tensor) -> th.Tensor:
        """Score points of each copy's own: (S, N, 2), (S, N, C) -> (S, N), in nats."""

        def score(state: Weights, points: th.Tensor, condition: th.Tensor) -> th.Tensor:
            return functional_call(self._template, {**state, **self._shared}, (points, condition))

        states = {**self.weights, **self._own}
        if self._template.stackable:
            return vmap(score)(states, points, condition)
        each = zip(points, condition, strict=True)
        return th.stack([score(_of(states, i), x, c) for i, (x, c) in enumerate(each)])

    def member(self, index: int) -> FlowModel:
        """Return one copy as an ordinary module with weights of its own."""
        model = make_model(self.name, self.condition_dim, self.seeds[index])
        model.load_state_dict(_of(self.weights, index), strict=False)
        return model.eval()


def _of(states: Weights, index: int) -> Weights:
    return {name: value[index] for name, value in states.items()}
