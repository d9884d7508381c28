"""RealNVP against zuko's of the same shape: forward and backward pass of sampling and scoring."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

import torch as th
from torch.func import functional_call

from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.distributions import RealNVP
from sb3_flowpolicy.engine.compiling import Compiled

BATCH_SIZE, ACTION_DIM, CONTEXT_DIM, LAYERS, HIDDEN = 256, 8, 256, 4, (10, 10)
# Per piece of work, enough to make the clock's overhead negligible.
N_PASSES = 10

# context -> samples (B, D) and their log-densities (B,)
Sampler = Callable[[th.Tensor], tuple[th.Tensor, th.Tensor]]


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return zuko's flow and ours, eager and (unless ``quick``) compiled."""
    title = f"batch {BATCH_SIZE}, D = {ACTION_DIM}, context {CONTEXT_DIM}, {LAYERS} couplings"
    candidates = [Candidate("zuko RealNVP", _zuko), Candidate("RealNVP", _eager)]
    if not quick:
        candidates.append(Candidate("RealNVP, compiled", _compiled))
    return [Benchmark(f"{title}, forward and backward", "passes", candidates)]


def _flow() -> RealNVP:
    return RealNVP(ACTION_DIM, CONTEXT_DIM, layers=LAYERS, hidden=HIDDEN, init="default")


def _eager() -> Work:
    flow = _flow()

    def sample(context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return flow.rsample_and_log_prob(context, th.randn(BATCH_SIZE, ACTION_DIM))

    return _passes(sample, list(flow.parameters()))


def _zuko() -> Work:
    # Imported late: it disables torch's validation of distributions in the whole process, which
    # would speed up SB3's SAC in the other groups.
    zuko = import_module("zuko")
    flow = zuko.flows.RealNVP(ACTION_DIM, CONTEXT_DIM, transforms=LAYERS, hidden_features=HIDDEN)
    return _passes(lambda context: flow(context).rsample_and_log_prob(), list(flow.parameters()))


def _passes(sample: Sampler, parameters: list[th.nn.Parameter]) -> Work:
    """Differentiate with respect to the parameters and the context."""
    context = th.randn(BATCH_SIZE, CONTEXT_DIM, requires_grad=True)

    def work() -> float:
        for _ in range(N_PASSES):
            value, log_prob = sample(context)
            th.autograd.grad(value.sum() + log_prob.sum(), [context, *parameters])
        return N_PASSES

    return work


class _Sampling(th.nn.Module):
    """Makes ``functional_call``, which calls ``forward``, sample and score."""

    def __init__(self, flow: RealNVP) -> None:
        super().__init__()
        self.flow = flow

    def forward(self, context: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self.flow.rsample_and_log_prob(context, noise)


def _compiled() -> Work:
    """Compile both passes into one graph, as the engine does."""
    sampling = _Sampling(_flow())
    parameters = {name: value.detach() for name, value in sampling.named_parameters()}
    context = th.randn(BATCH_SIZE, CONTEXT_DIM)

    def both_passes(
        parameters: dict[str, th.Tensor], context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, ...]:
        context = context.detach().requires_grad_()
        leaves = {name: part.detach().requires_grad_() for name, part in parameters.items()}
        value, log_prob = functional_call(sampling, leaves, (context, noise))
        return th.autograd.grad(value.sum() + log_prob.sum(), [context, *leaves.values()])

    function = Compiled(both_passes, "RealNVP", context.device)

    def work() -> float:
        for _ in range(N_PASSES):
            function("passes", parameters, context, th.randn(BATCH_SIZE, ACTION_DIM))
        return N_PASSES

    return work
