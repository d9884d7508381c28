"""Acting without the overhead of Python: sampling becomes a graph once a policy has acted often."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import torch as th
from torch import nn

# Recording a graph and its first calls take up to two tenths of a second. A flow saves that in
# about as many calls with one observation.
CALLS_WORTH_TRACING = 500


class TracedCalls:
    """Calls functions of modules and tensors; those called often, as a recorded graph.

    A flow consists of some sixty small operations. For one observation, calling them from Python
    takes several times as long as the arithmetic. ``torch.jit.trace`` records the operations, so
    the results are the same. A graph shares the parameters of the modules: it follows optimizers
    and ``load_state_dict``. It does not notice hooks, or parts of the modules that are replaced.

    A function that branches on the values of tensors runs as it is, and so does every function
    where torch has no ``torch.jit.trace``, which it calls deprecated.

    Graphs are neither copied nor pickled.
    """

    def __init__(self) -> None:
        self._calls: Counter[Any] = Counter()
        self._graphs: dict[Any, Callable[..., th.Tensor]] = {}

    def __call__(
        self,
        function: Callable[..., th.Tensor],
        modules: tuple[nn.Module, ...],
        *tensors: th.Tensor,
    ) -> th.Tensor:
        """Return ``function(*modules, *tensors)``; gradients must be disabled.

        A graph serves one function with one shape, type and device of each tensor, and modules that
        are all in training mode or all not.
        """
        shapes = [(tensor.shape, tensor.dtype, tensor.device) for tensor in tensors]
        key = (function, modules, modules[0].training, *shapes)
        graph = self._graphs.get(key)
        if graph is not None:
            with th.inference_mode():  # saves an eighth of the time
                found = graph(*tensors)
            return found.clone()  # an ordinary tensor again
        self._calls[key] += 1
        if self._calls[key] >= CALLS_WORTH_TRACING:
            self._graphs[key] = _trace(function, modules, tensors)
        return function(*modules, *tensors)

    def __reduce__(self) -> tuple[type[TracedCalls], tuple[()]]:
        return TracedCalls, ()


class AsForward(nn.Module):
    """A function of a module as ``forward``, for ``functional_call`` and ``jit.trace``.

    The module's parameters have the prefix ``module.``.
    """

    def __init__(self, module: nn.Module, function: Callable[..., Any]) -> None:
        super().__init__()
        self.module = module
        self.function = function

    def forward(self, *arguments: Any) -> Any:
        """Call the function."""
        return self.function(*arguments)


def _trace(
    function: Callable[..., th.Tensor],
    modules: tuple[nn.Module, ...],
    tensors: tuple[th.Tensor, ...],
) -> Callable[..., th.Tensor]:
    """Record the graph, or return the function itself where that is not possible."""
    call = partial(function, *modules)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("always", th.jit.TracerWarning)
        # Densities compare shapes, which do not change.
        warnings.filterwarnings(
            "ignore", category=th.jit.TracerWarning, module=r"sb3_flowpolicy\.distributions\.base"
        )
        try:
            module = AsForward(nn.ModuleList(modules), call)
            graph = th.jit.trace(module, tensors, check_trace=False)
        except (AttributeError, RuntimeError):
            graph = None
    branches = any(issubclass(one.category, th.jit.TracerWarning) for one in caught)
    return call if graph is None or branches else graph
