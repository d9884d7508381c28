"""Small updates take one thread, larger ones all, and the setting is left as it was."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch as th

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.engine.arithmetic import WORTH_SHARING, threads_for


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    before = th.get_num_threads()
    th.set_num_threads(2)
    yield
    th.set_num_threads(before)


@pytest.mark.parametrize(("units", "threads"), [(16, 1), (64, 2)])
def test_an_update_takes_as_many_threads_as_it_is_worth(units: int, threads: int) -> None:
    model = SACFlow(
        "GaussPolicy",
        "Pendulum-v1",
        policy_kwargs={"net_arch": [units, units]},
        learning_starts=20,
        compile=False,
        seed=0,
    ).learn(21)
    engine = model._runtime._engine
    assert engine is not None
    used = []
    update = engine._update

    def watched(*arguments: Any) -> th.Tensor:
        used.append(th.get_num_threads())
        return update(*arguments)

    engine._update = watched
    model.train(gradient_steps=2, batch_size=256)
    assert used == [threads, threads]
    assert th.get_num_threads() == 2


def test_the_setting_comes_back_after_an_error() -> None:
    with pytest.raises(RuntimeError, match="inside"), threads_for(WORTH_SHARING):
        raise RuntimeError("inside")
    assert th.get_num_threads() == 2
