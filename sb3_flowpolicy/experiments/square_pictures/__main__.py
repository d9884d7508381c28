"""`python -m sb3_flowpolicy.experiments.square_pictures`: do the fingers move together?"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_flowpolicy.common.command_line import at_least, run

_DESCRIPTION = """\
Draw how trained agents explore a task of the Square, side by side, a column per model:

  together.png     sampled targets of each finger at one state, colored by what the other fingers do
                   in the same sample, and paths of the square: do the fingers move together?
  correlation.png  absolute correlation of the eight actions (thesis Fig. 3.17); a chessboard means
                   that all x move together, and all y
  film.webp        one episode of each agent from a second before the end of the warm-up

The titles contain each model's seed and training steps. Film and targets show the first of ten
episodes in which the agent does not lose the square (if it loses all, the first); its warm-up is
deterministic, so that the agents start to explore from similar states.
Paths, correlations, and the numbers printed are those of further episodes, sampled from the start
and kept whatever their end. The same model, --seed, and --episodes give the same column, whatever
the other models are."""
_EPILOG = """\
example:
  square_pictures --env SquareMoveX-v1 --model NF=flow.zip --model Gauss=gauss.zip -o pictures
after `python -m sb3_flowpolicy.experiments.`; models are saved by `SACFlow.save`,
`python -m sb3_flowpolicy.seeds`, or rl_zoo3. Three models take about half a minute."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.experiments.square_pictures",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "--model",
        metavar="LABEL=FILE",
        type=_labeled,
        action="append",
        required=True,
        help="name and zip file of an agent; once per agent",
    )
    add("--env", default="SquareMoveX-v1", help="task (default: %(default)s)")
    add("-o", "--output", type=Path, default=Path("pictures"), help="folder (default: pictures)")
    add("--seed", type=at_least(0), default=0, help="of the episodes (default: 0)")
    add("--episodes", type=at_least(1), default=20, help="paths of the square (default: 20)")
    args = parser.parse_args(arguments)

    from sb3_flowpolicy.experiments.square_pictures import figures
    from sb3_flowpolicy.experiments.square_pictures.record import load_agent, record

    # All models are checked before the first is played.
    agents = [(label, load_agent(path, args.env)) for label, path in args.model]
    recordings = [
        record(label, model, args.env, args.seed, args.episodes) for label, model in agents
    ]
    args.output.mkdir(parents=True, exist_ok=True)
    figures.together_figure(recordings).savefig(args.output / "together.png", dpi=110)
    figures.correlation_figure(recordings).savefig(args.output / "correlation.png", dpi=110)
    figures.write_film(recordings, args.output / "film.webp")
    for recording in recordings:
        print(
            f"{recording.label} ({recording.origin}): entropy {recording.entropy:.1f} nats, x std "
            f"{recording.x_std:.3f}, lost {recording.dropped.sum()} of {len(recording.dropped)} "
            "squares"
        )
    print(f"Pictures and film: {args.output}")


def _labeled(text: str) -> tuple[str, Path]:
    label, found, path = text.partition("=")
    if not (label and found and path):
        raise argparse.ArgumentTypeError(f"must be LABEL=FILE, such as NF=flow.zip, got {text!r}")
    return label, Path(path)


if __name__ == "__main__":
    run(main)
