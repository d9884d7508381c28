"""How the update is compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch as th


def compile_update(update: Callable[..., Any]) -> Callable[..., Any]:
    """Compile an update into one graph: gradients, optimisers and target networks included.

    Compilation itself happens at the first call, and is cached on disk across runs by torch.
    """
    compiled = th.compile(update, fullgraph=True, dynamic=False)

    def call(*arguments: Any) -> Any:
        # Lets torch.autograd.grad be traced; switched on for our graph alone.
        with th._dynamo.config.patch(trace_autograd_ops=True):
            return compiled(*arguments)

    return call
