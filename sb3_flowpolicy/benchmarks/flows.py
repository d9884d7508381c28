"""RealNVP against zuko's of the same shape: sample, score, and differentiate both."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

import torch as th
from torch.func import functional_call

from sb3_flowpolicy.benchmarks.timing import Contest, Entrant, UnavailableError, Work
from sb3_flowpolicy.distributions import RealNVP
from sb3_flowpolicy.engine.compiling import Compiled

BATCH_SIZE, ACTION_DIM, CONTEXT_DIM, LAYERS, HIDDEN = 256, 8, 256, 4, (10, 10)
# Per piece of work: enough to hide the clock.
N_PASSES = 10

# context -> samples (B, D) and their log-densities (B,)
Sampler = Callable[[th.Tensor], tuple[th.Tensor, th.Tensor]]


def contests(quick: bool = False) -> list[Contest]:
    """Eager, compiled, and zuko; ``quick`` does not compile."""
    compiled = [] if quick else [Entrant("RealNVP, compiled", _compiled)]
    title = f"batch {BATCH_SIZE}, D = {ACTION_DIM}, context {CONTEXT_DIM}, {LAYERS} couplings"
    entrants = [Entrant("zuko RealNVP", _zuko), Entrant("RealNVP", _eager), *compiled]
    return [Contest(f"{title}, forward and backward", "passes", entrants)]


def _flow() -> RealNVP:
    return RealNVP(ACTION_DIM, CONTEXT_DIM, layers=LAYERS, hidden=HIDDEN, init="default")


def _eager() -> Work:
    flow = _flow()

    def sample(context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return flow.rsample_and_log_prob(context, th.randn(BATCH_SIZE, ACTION_DIM))

    return _passes(sample, list(flow.parameters()))


def _zuko() -> Work:
    try:
        # Imported here only: it switches off torch's checks of distributions for the process,
        # which would speed up SB3's SAC in the other groups.
        zuko = import_module("zuko")
    except ModuleNotFoundError as error:
        raise UnavailableError("zuko is not installed") from error
    flow = zuko.flows.RealNVP(ACTION_DIM, CONTEXT_DIM, transforms=LAYERS, hidden_features=HIDDEN)

    def sample(context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return flow(context).rsample_and_log_prob()

    return _passes(sample, list(flow.parameters()))


def _passes(sample: Sampler, parameters: list[th.nn.Parameter]) -> Work:
    """Return passes that differentiate with respect to the parameters and the context."""
    context = th.randn(BATCH_SIZE, CONTEXT_DIM, requires_grad=True)

    def work() -> float:
        for _ in range(N_PASSES):
            value, log_prob = sample(context)
            th.autograd.grad(value.sum() + log_prob.sum(), [context, *parameters])
        return N_PASSES

    return work


def _compiled() -> Work:
    """Compile both passes into one graph, as the engine does."""
    flow = _flow()
    parameters = {name: value.detach() for name, value in flow.named_parameters()}
    context = th.randn(BATCH_SIZE, CONTEXT_DIM)

    class Sampling(th.nn.Module):
        """``functional_call`` calls ``forward``: this one samples and scores."""

        def __init__(self) -> None:
            super().__init__()
            self.flow = flow

        def forward(self, context: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
            return self.flow.rsample_and_log_prob(context, noise)

    sampling = Sampling()

    def both_passes(
        parameters: dict[str, th.Tensor], context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, ...]:
        context = context.detach().requires_grad_()
        leaves = {f"flow.{key}": part.detach().requires_grad_() for key, part in parameters.items()}
        value, log_prob = functional_call(sampling, leaves, (context, noise))
        return th.autograd.grad(value.sum() + log_prob.sum(), [context, *leaves.values()])

    function = Compiled(both_passes, "RealNVP", context.device)

    def work() -> float:
        for _ in range(N_PASSES):
            function("passes", parameters, context, th.randn(BATCH_SIZE, ACTION_DIM))
        return N_PASSES

    return work
