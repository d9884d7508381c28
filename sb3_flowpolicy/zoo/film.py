"""`python -m sb3_flowpolicy.zoo.film`: video and picture sequence of a trained model."""

from pathlib import Path

from sb3_flowpolicy.common.command_line import at_least, run
from sb3_flowpolicy.diagnostics.episodes import episode_frames, sequence_figure, write_video
from sb3_flowpolicy.zoo.saved_run import load_run, run_parser


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = run_parser(
        "film",
        "Write an MP4 of a trained model with its action samples drawn as dots, and optionally a "
        "picture of consecutive steps. Works for all environments of this package.",
    )
    add = parser.add_argument
    add("-n", "--n-episodes", type=at_least(1), default=1, help="episodes in the video")
    add("--n-samples", type=at_least(1), default=300, help="action samples drawn at each step")
    add("--deterministic", action="store_true", help="act without exploration")
    add("--slow-down", type=float, default=1.0, help="times slower than real time")
    add("-o", "--output", type=Path, help="video (default: film.mp4 next to the model)")
    add("--sequence", type=Path, help="picture of consecutive steps of the first episode")
    add("--first-step", type=at_least(0), default=0, help="first step of the sequence")
    add("--steps", type=at_least(1), default=7, help="number of steps of the sequence, at most")
    args = parser.parse_args(arguments)

    model, env, path = load_run(args)
    episodes = [
        episode_frames(model, env, args.n_samples, args.deterministic)
        for _ in range(args.n_episodes)
    ]
    if args.sequence is not None:
        sequence_figure(episodes[0], args.first_step, args.steps).savefig(args.sequence, dpi=150)
        print(f"Sequence: {args.sequence}")
    output = args.output or path.parent / "film.mp4"
    fps = env.get_attr("metadata")[0]["render_fps"] / args.slow_down
    write_video([frame for frames in episodes for frame in frames], output, fps)
    print(f"Video of {len(episodes)} episodes: {output}")
    env.close()


if __name__ == "__main__":
    run(main)
