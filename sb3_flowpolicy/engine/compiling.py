"""How the update is compiled, and what happens where it cannot be."""

from __future__ import annotations

import sys
import time
import warnings

import torch as th

from sb3_flowpolicy.engine.update import Batch, Losses, TrainState, Update


def compile_update(update: Update) -> Update:
    """Compile an update into one graph: gradients, optimisers and target networks included.

    Compilation happens at the first call, which says so: it takes 10 to 30 seconds, less from the
    second run on, as torch caches it on disk. Where it fails, for want of a C++ compiler say, the
    update runs eagerly ever after.

    Args:
        update: The update of :func:`~sb3_flowpolicy.engine.update.make_update`.

    Returns:
        A function that does the same.
    """
    compiled = th.compile(update, fullgraph=True, dynamic=False)
    known: set[bool] = set()
    broken = False

    def call(
        state: TrainState, batch: Batch, learning_rate: th.Tensor, move_target: bool
    ) -> Losses:
        nonlocal broken
        if broken:
            return update(state, batch, learning_rate, move_target)
        if move_target not in known:
            _say("Compiling the SAC update ...")
        start = time.perf_counter()
        try:
            # Lets torch.autograd.grad be traced; switched on for our graph alone.
            with th._dynamo.config.patch(trace_autograd_ops=True):
                losses = compiled(state, batch, learning_rate, move_target)
        except (th._dynamo.exc.TorchDynamoException, th._inductor.exc.InductorError) as error:
            broken = True
            reason = str(error).strip().splitlines()[0]
            warnings.warn(
                "the SAC update could not be compiled and runs eagerly: the same numbers, only "
                f"slower ({type(error).__name__}: {reason})",
                RuntimeWarning,
                stacklevel=2,
            )
            return update(state, batch, learning_rate, move_target)
        if move_target not in known:
            known.add(move_target)
            _say(f"Compiled the SAC update in {time.perf_counter() - start:.0f} s")
        return losses

    return call


def _say(text: str) -> None:
    """Tell whoever is waiting, whatever the verbosity, and leave stdout to the program."""
    print(text, file=sys.stderr, flush=True)
