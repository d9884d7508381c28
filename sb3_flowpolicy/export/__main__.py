"""`python -m sb3_flowpolicy.export`: a trained model as a safe bundle or an ONNX file."""

from __future__ import annotations

import argparse
import pickle
import sys
import zipfile
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecNormalize

from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.bundle.model import SUFFIX
from sb3_flowpolicy.export.onnx_export import export_onnx

_EXAMPLES = """\
examples:
  %(prog)s safe logs/sac_flow/TunnelDiagonal-v0_1/TunnelDiagonal-v0.zip
  %(prog)s onnx logs/sac_flow/TunnelDiagonal-v0_1/best_model.zip --output robot.onnx
  %(prog)s onnx model.safetensors --stochastic

MODEL is a zip that SACFlow.save, SAC.save with one of our policies, or rl_zoo3 wrote, or a safe
bundle. A zip and vecnormalize.pkl are pickles, and loading one runs whatever code is in it: export
your own, and give others the result. A safe bundle runs nothing.
"""


def main(arguments: list[str] | None = None) -> None:
    """Export the model that the command line names, and print where to.

    Args:
        arguments: Command line without the program's name. Default: that of the process.
    """
    parser = _parser()
    args = parser.parse_args(arguments)
    try:
        if args.stochastic and args.format == "safe":
            raise ValueError("--stochastic is for onnx: a safe bundle can always sample")
        model = _load_model(args.model)
        # Beside a bundle no pickle is looked for: a bundle has its statistics inside.
        beside = find_statistics(args.model) if zipfile.is_zipfile(args.model) else None
        statistics = args.vecnormalize or beside
        vec_normalize = None if statistics is None else _load_statistics(statistics)
        output = args.output or args.model.with_suffix("." + _SUFFIXES[args.format])
        if args.format == "safe":
            path = model.save_safe(output, vec_normalize)
        else:
            path = export_onnx(
                model, output, stochastic=args.stochastic, vec_normalize=vec_normalize
            )
    except (ValueError, OSError) as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    except ModuleNotFoundError as error:
        parser.exit(2, f'{parser.prog}: {error}; pip install "sb3_flowpolicy[export]" brings it\n')
    inside = f" with the statistics of {statistics}" if statistics is not None else ""
    print(f"{path}: {path.stat().st_size / 1024:.0f} KiB{inside}")


_SUFFIXES = {"safe": SUFFIX.removeprefix("."), "onnx": "onnx"}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.export",
        description="Turn a trained model into a file that can be shared without sharing code "
        "(safe), or into one that runs without torch (onnx).",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("format", choices=_SUFFIXES, help="safe: a bundle for SACFlow.load_safe; onnx: a graph")
    add("model", type=Path, metavar="MODEL", help="zip or safe bundle")
    add("-o", "--output", type=Path, help="file to write (default: beside MODEL, named like it)")
    add(
        "--vecnormalize",
        type=Path,
        metavar="FILE",
        help="statistics to include (default: vecnormalize.pkl where rl_zoo3 puts it)",
    )
    add("--stochastic", action="store_true", help="onnx: also a sampled action, noise is an input")
    return parser


def find_statistics(model: Path) -> Path | None:
    """Return the ``vecnormalize.pkl`` that belongs to a model, where there is one.

    rl_zoo3 writes ``ENV_1/ENV.zip`` and ``ENV_1/ENV/vecnormalize.pkl``; SB3's checkpoints are
    ``rl_model_500_steps.zip`` and ``rl_model_vecnormalize_500_steps.pkl``.

    Raises:
        ValueError: If there are several, and none of these.
    """
    folder, (stem, _, steps) = model.parent, model.stem.partition("_model_")
    checkpoint = folder / f"{stem}_model_vecnormalize_{steps}.pkl"
    if steps and checkpoint.is_file():
        return checkpoint
    beside = folder / "vecnormalize.pkl"
    if beside.is_file():
        return beside
    found = sorted(folder.glob("*/vecnormalize.pkl"))
    own = folder / model.stem / "vecnormalize.pkl"
    if own in found:
        return own
    if len(found) > 1:
        names = ", ".join(map(str, found))
        raise ValueError(f"--vecnormalize must say which belongs to {model}, found {names}")
    return found[0] if found else None


def _load_model(path: Path) -> SACFlow:
    if not path.is_file():
        raise ValueError(f"MODEL must be a file that exists, got {path}")
    if not zipfile.is_zipfile(path):
        return SACFlow.load_safe(path, device="cpu")
    nothing: Any = object()
    try:
        # A replay buffer is not wanted, and could not be built without the environment for HER.
        model = SACFlow.load(path, device="cpu", replay_buffer=nothing)
    # What a pickle of someone's making raises, nobody knows.
    except Exception as error:
        raise ValueError(
            f"MODEL must be a model that SACFlow or SAC saved, got {path} "
            f"({type(error).__name__}: {error})"
        ) from error
    model.replay_buffer = None
    return model


def _load_statistics(path: Path) -> VecNormalize:
    if not path.is_file():
        raise ValueError(f"--vecnormalize must be a file that exists, got {path}")
    try:
        with open(path, "rb") as file:
            found = pickle.load(file)
    except Exception as error:
        raise ValueError(
            f"--vecnormalize must be what VecNormalize.save wrote, got {path} "
            f"({type(error).__name__}: {error})"
        ) from error
    if not isinstance(found, VecNormalize):
        raise ValueError(f"--vecnormalize must hold a VecNormalize, got {type(found).__name__}")
    return found


if __name__ == "__main__":
    main(sys.argv[1:])
