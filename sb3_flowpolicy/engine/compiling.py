"""Compile functions of tensors; run them eagerly where that fails."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Hashable
from types import FunctionType
from typing import Any

import torch as th


class Compiler:
    """Whether, and for which device, the functions of an engine are compiled.

    Args:
        device: Device of their tensors.
        enabled: Whether to compile. Once a function could not be compiled, none is.
    """

    def __init__(self, device: th.device, enabled: bool = True) -> None:
        self.device = device
        self.enabled = enabled


class Compiled:
    """A function of tensors compiled into one graph per kind of call; its closure must not change.

    The first call compiles and prints a message: the SAC update takes 5 to 30 seconds, less from
    the second run on, as torch caches it on disk. If compiling fails because a C++ compiler or a
    feature of torch is missing, all functions of ``compiler`` run eagerly from then on, with one
    warning.
    """

    def __init__(self, function: Callable[..., Any], name: str, compiler: Compiler) -> None:
        self.function = function
        self.name = name
        self._compiler = compiler
        self._graphs: dict[Hashable, Callable[..., Any]] = {}

    def __contains__(self, key: Hashable) -> bool:
        """Whether such calls run a graph."""
        return self._compiler.enabled and key in self._graphs

    def __call__(self, key: Hashable, *arguments: Any) -> Any:
        """Call the function; ``key`` tells apart calls that need different graphs."""
        if not self._compiler.enabled:
            return self.function(*arguments)
        graph = self._graphs.get(key)
        return self._compile(key, *arguments) if graph is None else graph(*arguments)

    def _compile(self, key: Hashable, *arguments: Any) -> Any:
        print(f"Compiling {self.name} ...", file=sys.stderr, flush=True)
        start = time.perf_counter()
        # A function of its own per graph: dynamo keeps its graphs with a function's code.
        code = self.function.__code__.replace()
        function = FunctionType(code, self.function.__globals__, closure=self.function.__closure__)
        try:
            graph = th.compile(
                function, fullgraph=True, dynamic=False, options=_options(self._compiler.device)
            )
        except (AttributeError, RuntimeError) as error:  # this torch or Python lacks a feature
            return self._run_eagerly(error, *arguments)
        try:
            # Lets torch.autograd.grad be traced; switched on for our graph alone.
            with th._dynamo.config.patch(trace_autograd_ops=True):
                result = graph(*arguments)
        except (th._dynamo.exc.TorchDynamoException, th._inductor.exc.InductorError) as error:
            return self._run_eagerly(error, *arguments)
        seconds = time.perf_counter() - start
        print(f"Compiled {self.name} in {seconds:.0f} s", file=sys.stderr, flush=True)
        self._graphs[key] = graph
        return result

    def _run_eagerly(self, error: Exception, *arguments: Any) -> Any:
        self._compiler.enabled = False
        warnings.warn(
            f"{self.name} could not be compiled and runs eagerly: the same numbers, only "
            f"slower ({type(error).__name__}: {str(error).strip().splitlines()[0]})",
            RuntimeWarning,
            stacklevel=4,
        )
        return self.function(*arguments)


def _options(device: th.device) -> dict[str, Any]:
    """Return the options for the device, or raise AttributeError if torch lacks a feature."""
    th._dynamo.config.trace_autograd_ops  # noqa: B018 (new in torch 2.11)
    return {
        # Dynamo would check at each call that modules and shapes are those it compiled for, which
        # takes as long as the update of a small network. Here the caller does so: see __call__.
        "guard_filter_fn": th.compiler.skip_all_guards_unsafe,
        # Inductor would leave loops over two or three action dimensions scalar: exp, tanh and
        # log1p then cost as much as all products of a small network together.
        "cpp.enable_tiling_heuristics": False,
        # Launching kernels from Python would cost more than running them.
        "triton.cudagraphs" if device.type == "cuda" else "cpp_wrapper": True,
    }
