"""Forward and backward passes of RealNVP and of zuko's RealNVP of the same shape."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module

import torch as th

from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.distributions import RealNVP

BATCH_SIZE, ACTION_DIM, CONTEXT_DIM, LAYERS, HIDDEN = 256, 8, 256, 4, (10, 10)
# Per piece of work, enough to make the clock's overhead negligible.
N_PASSES = 10


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return zuko's flow and ours, eager and (unless ``quick``) compiled."""
    title = f"batch {BATCH_SIZE}, D = {ACTION_DIM}, context {CONTEXT_DIM}, {LAYERS} couplings"
    candidates = [Candidate("zuko RealNVP", _zuko), Candidate("RealNVP", partial(_ours, False))]
    if not quick:
        candidates.append(Candidate("RealNVP, compiled", partial(_ours, True)))
    return [Benchmark(f"{title}, forward and backward", "passes", candidates)]


def _ours(compiled: bool) -> Work:
    flow = RealNVP(ACTION_DIM, CONTEXT_DIM, layers=LAYERS, hidden=HIDDEN, init="default")
    sample = th.compile(flow.rsample_and_log_prob) if compiled else flow.rsample_and_log_prob
    return _passes(flow, lambda context: sample(context, th.randn(BATCH_SIZE, ACTION_DIM)))


def _zuko() -> Work:
    # Imported late: it disables torch's validation of distributions in the whole process, which
    # would speed up SB3's SAC in the other groups.
    zuko = import_module("zuko")
    flow = zuko.flows.RealNVP(ACTION_DIM, CONTEXT_DIM, transforms=LAYERS, hidden_features=HIDDEN)
    return _passes(flow, lambda context: flow(context).rsample_and_log_prob())


def _passes(flow: th.nn.Module, sample: Callable[[th.Tensor], tuple[th.Tensor, th.Tensor]]) -> Work:
    """Differentiate samples (B, D) and their log-densities (B,) by parameters and context."""
    context = th.randn(BATCH_SIZE, CONTEXT_DIM, requires_grad=True)
    parameters = list(flow.parameters())

    def work() -> float:
        for _ in range(N_PASSES):
            value, log_prob = sample(context)
            th.autograd.grad(value.sum() + log_prob.sum(), [context, *parameters])
        return N_PASSES

    return work
