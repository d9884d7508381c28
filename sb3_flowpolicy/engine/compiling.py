"""How a function of tensors is compiled, and what happens where it cannot be."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Hashable
from types import FunctionType
from typing import Any

import torch as th


class Compiled:
    """A function compiled into one graph per kind of call.

    Compilation happens at the first call, which says so: the SAC update takes 10 to 30 seconds,
    less from the second run on, as torch caches it on disk. Where it fails, for want of a C++
    compiler say, the function runs eagerly ever after, with one warning.

    Args:
        function: Function of tensors; its closure must not change.
        name: What to call it in messages.
        device: Where the tensors are.
    """

    def __init__(self, function: Callable[..., Any], name: str, device: th.device) -> None:
        self.function = function
        self.name = name
        self.broken = False
        self._graphs: dict[Hashable, Callable[..., Any]] = {}
        # Dynamo would check at each call that modules and shapes are those it compiled for, which
        # takes as long as the update of a small network. Here the caller knows: see __call__.
        self._options: dict[str, Any] = {"guard_filter_fn": th.compiler.skip_all_guards_unsafe}
        # Inductor would leave loops over two or three action dimensions scalar: exp, tanh and
        # log1p then cost as much as all products of a small network together.
        self._options["cpp.enable_tiling_heuristics"] = False
        # Launching kernels from Python would cost more than running them.
        faster = "triton.cudagraphs" if device.type == "cuda" else "cpp_wrapper"
        self._options[faster] = True

    def __call__(self, key: Hashable, *arguments: Any) -> Any:
        """Call the function.

        Args:
            key: Tells apart calls that need different graphs: other shapes, other flags.
            *arguments: The function's arguments.
        """
        if self.broken:
            return self.function(*arguments)
        graph = self._graphs.get(key)
        return self._compile(key, *arguments) if graph is None else graph(*arguments)

    def _compile(self, key: Hashable, *arguments: Any) -> Any:
        _say(f"Compiling {self.name} ...")
        start = time.perf_counter()
        # A function of its own per graph: dynamo keeps its graphs with a function's code.
        code = self.function.__code__.replace()
        function = FunctionType(code, self.function.__globals__, closure=self.function.__closure__)
        graph = th.compile(function, fullgraph=True, dynamic=False, options=self._options)
        try:
            # Lets torch.autograd.grad be traced; switched on for our graph alone.
            with th._dynamo.config.patch(trace_autograd_ops=True):
                result = graph(*arguments)
        except (th._dynamo.exc.TorchDynamoException, th._inductor.exc.InductorError) as error:
            self.broken = True
            warnings.warn(
                f"{self.name} could not be compiled and runs eagerly: the same numbers, only "
                f"slower ({type(error).__name__}: {str(error).strip().splitlines()[0]})",
                RuntimeWarning,
                stacklevel=3,
            )
            return self.function(*arguments)
        _say(f"Compiled {self.name} in {time.perf_counter() - start:.0f} s")
        self._graphs[key] = graph
        return result


def _say(text: str) -> None:
    """Tell whoever is waiting, whatever the verbosity, and leave stdout to the program."""
    print(text, file=sys.stderr, flush=True)
