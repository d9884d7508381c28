"""Subnormal numbers are flushed while the engine works, and nowhere else."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext

import pytest
import torch as th

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.engine.arithmetic import flushed_subnormals

TINY = 1e-40

pytestmark = pytest.mark.skipif(
    not th.set_flush_denormal(False), reason="this processor cannot flush subnormal numbers"
)


@pytest.fixture(autouse=True)
def _as_torch_comes() -> Iterator[None]:
    th.set_flush_denormal(False)
    yield
    th.set_flush_denormal(False)


def is_flushed(size: int = 1) -> bool:
    """Whether every thread flushes; large tensors are shared among threads."""
    return not (th.full((size,), TINY) * 1).any()


@pytest.mark.parametrize("size", [1, 1 << 20])
def test_flushed_within_the_block_alone(size: int) -> None:
    assert not is_flushed(size)
    with flushed_subnormals():
        assert is_flushed(size)
    assert not is_flushed(size)


def test_restored_after_an_error() -> None:
    with pytest.raises(KeyError), flushed_subnormals():
        raise KeyError
    assert not is_flushed()


def test_a_program_that_asked_for_flushing_keeps_it() -> None:
    th.set_flush_denormal(True)
    with flushed_subnormals():
        assert is_flushed()
    assert is_flushed()


@pytest.mark.parametrize("sb3_loop", [False, True], ids=["engine", "sb3"])
def test_training_leaves_no_subnormal_numbers(sb3_loop: bool) -> None:
    kwargs = {"net_arch": [8]}
    model = SACFlow(
        "GaussPolicy",
        "Pendulum-v1",
        learning_starts=20,
        policy_kwargs=kwargs,
        compile=False,
        seed=0,
    )
    if sb3_loop:  # a hook is what sends it there
        model.actor.optimizer.register_step_post_hook(lambda *_: None)
    with pytest.warns(UserWarning, match="the stock loop") if sb3_loop else nullcontext():
        model.learn(22)
        # What a unit that is never active ends with.
        for state in model.critic.optimizer.state.values():
            state["exp_avg"].view(-1)[0] = TINY
        first = next(iter(model.critic.q_networks[0].children()))
        with th.no_grad():
            first.weight[0] = 0
            first.bias[0] = -100.0
        model.train(1, 16)
    means = th.cat([s["exp_avg"].view(-1) for s in model.critic.optimizer.state.values()])
    smallest = means[means != 0].abs().min().item()
    assert smallest >= th.finfo(th.float32).tiny
    assert not is_flushed()
