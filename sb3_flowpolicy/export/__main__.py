"""`python -m sb3_flowpolicy.export`: write a trained model as a safe bundle or an ONNX file."""

from __future__ import annotations

import argparse
import pickle
import zipfile
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecNormalize

from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.bundle.model import SUFFIX
from sb3_flowpolicy.common.command_line import run
from sb3_flowpolicy.export.onnx_export import export_onnx

_EXAMPLES = """\
examples:
  %(prog)s safe logs/sac_flow/TunnelDiagonal-v0_1/TunnelDiagonal-v0.zip
  %(prog)s onnx logs/sac_flow/TunnelDiagonal-v0_1/best_model.zip --output robot.onnx
  %(prog)s onnx model.safetensors --stochastic

MODEL is a zip of SACFlow.save, of SAC.save with one of our policies, or of rl_zoo3, or a safe
bundle. Zips and vecnormalize.pkl are pickles, and loading a pickle runs the code in it: export your
own, and share the result. Loading a safe bundle runs no code.
"""
_SUFFIXES = {"safe": SUFFIX, "onnx": ".onnx"}


def main(arguments: list[str] | None = None) -> None:
    """Export the model that the command line names, and print the path of the result."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.export",
        description="Write a trained model to a file that can be shared safely (safe), or to one "
        "that runs without torch (onnx).",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("format", choices=_SUFFIXES, help="safe: a bundle for SACFlow.load_safe; onnx: a graph")
    add("model", type=Path, metavar="MODEL", help="zip or safe bundle")
    add("-o", "--output", type=Path, help="file to write (default: MODEL with the new suffix)")
    add(
        "--vecnormalize",
        type=Path,
        metavar="FILE",
        help="statistics to include (default: the vecnormalize.pkl that rl_zoo3 saved with MODEL)",
    )
    add("--stochastic", action="store_true", help="onnx: also sample (a bundle always can)")
    args = parser.parse_args(arguments)
    model, statistics = _load_model(args.model), args.vecnormalize
    # A bundle contains its statistics, so no pickle next to it is opened.
    if statistics is None and zipfile.is_zipfile(args.model):
        statistics = find_statistics(args.model)
    vec_normalize = None if statistics is None else _load_statistics(statistics)
    output = args.output or args.model.with_suffix(_SUFFIXES[args.format])
    if args.format == "safe":
        path = model.save_safe(output, vec_normalize)
    else:
        path = export_onnx(model, output, stochastic=args.stochastic, vec_normalize=vec_normalize)
    included = f" with the statistics of {statistics}" if statistics is not None else ""
    print(f"{path}: {path.stat().st_size / 1024:.0f} KiB{included}")


def find_statistics(model: Path) -> Path | None:
    """Return the ``vecnormalize.pkl`` that belongs to a model, if there is one.

    rl_zoo3 writes ``ENV_1/ENV.zip`` and ``ENV_1/ENV/vecnormalize.pkl``; SB3's checkpoints are
    ``rl_model_500_steps.zip`` and ``rl_model_vecnormalize_500_steps.pkl``.

    Raises:
        ValueError: If there are several, and none has the model's name.
    """
    folder, (stem, _, steps) = model.parent, model.stem.partition("_model_")
    own = (
        *([folder / f"{stem}_model_vecnormalize_{steps}.pkl"] if steps else []),
        folder / "vecnormalize.pkl",
        folder / model.stem / "vecnormalize.pkl",
    )
    found = [path for path in own if path.is_file()] or [*folder.glob("*/vecnormalize.pkl")]
    if len(found) > 1 and found[0] not in own:
        names = ", ".join(map(str, sorted(found)))
        raise ValueError(f"--vecnormalize must say which belongs to {model}, found {names}")
    return found[0] if found else None


def _load_model(path: Path) -> SACFlow:
    if not zipfile.is_zipfile(path):
        return SACFlow.load_safe(path, device="cpu")
    no_buffer: Any = object()
    # Keeps SB3 from building a buffer, which HER cannot do without an environment.
    model = SACFlow.load(path, device="cpu", replay_buffer=no_buffer)
    model.replay_buffer = None
    return model


def _load_statistics(path: Path) -> VecNormalize:
    found = pickle.loads(path.read_bytes())
    if not isinstance(found, VecNormalize):
        raise ValueError(f"{path} must be what VecNormalize.save wrote, got {type(found).__name__}")
    return found


if __name__ == "__main__":
    run(main)
