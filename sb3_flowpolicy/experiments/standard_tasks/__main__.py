"""``python -m sb3_flowpolicy.experiments.standard_tasks``: are our policies worse than stock?"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

_DESCRIPTION = """\
Train SAC, TQC, CrossQ, or PPO with its own policy and with ours on a standard task, with the same
settings: those that rl_zoo3 publishes, without gSDE and for fewer steps. Every test is written to a
CSV file. Runs that are in the file are not repeated, so an interrupted command continues. Give each
of several processes a file of its own, and all files to the last command. Needs the extras
[zoo] and [bullet]."""
COLUMNS = [
    *("task", "algorithm", "policy", "seed"),
    *("step", "test_return", "test_success", "seconds"),
]
_EPILOG = """\
examples:
  standard_tasks --task hopper --algorithms ppo --policies stock flow --csv hopper.csv
  standard_tasks --csv one.csv two.csv --figure curves.png
each after `python -m sb3_flowpolicy.experiments.`

"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Train the runs that the command line names and the files lack, and print a table."""
    # Slow imports that --help needs, as it lists what there is.
    import pandas as pd
    import torch as th
    from tqdm import tqdm

    from sb3_flowpolicy.common.command_line import at_least, check_folder_of
    from sb3_flowpolicy.common.files import replacing
    from sb3_flowpolicy.experiments.standard_tasks import rule, training
    from sb3_flowpolicy.experiments.standard_tasks.tasks import CANDIDATES, TASKS

    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.experiments.standard_tasks",
        description=_DESCRIPTION,
        epilog=_EPILOG + rule.RULE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--task", choices=list(TASKS), help="task to train on (default: none, only the table)")
    add("--algorithms", choices=list(CANDIDATES), nargs="+", help="default: all of the task's")
    add("--policies", nargs="+", help="default: all of the algorithm's, stock among them")
    add("--seeds", type=at_least(0), nargs="+", default=[1, 2, 3, 4, 5], help="default: 1 2 3 4 5")
    add("--episodes", type=at_least(1), default=5, help="episodes per test (default: 5)")
    add("--csv", type=Path, nargs="+", required=True, help="results; new runs go to the first")
    add("--figure", type=Path, metavar="FILE", help="also draw the curves")
    args = parser.parse_args(arguments)
    for option, path in (("--csv", args.csv[0]), ("--figure", args.figure)):
        check_folder_of(parser, option, path)
    th.set_num_threads(1)
    for path in args.csv[0 if args.task is None else 1 :]:
        if not path.exists():
            parser.error(f"--csv must name files with results, got {path}")
    tables = {path: pd.read_csv(path) for path in args.csv if path.exists()}
    done = {
        run
        for table in tables.values()
        for run in table[COLUMNS[:4]].itertuples(index=False, name=None)
    }
    runs = []
    if args.task is not None:
        for algorithm in args.algorithms or TASKS[args.task].steps:
            if algorithm not in TASKS[args.task].steps:
                parser.error(f"--algorithms: {args.task} has no settings of {algorithm}")
            known = CANDIDATES[algorithm]
            if unknown := set(args.policies or ()) - set(known):
                parser.error(f"--policies must be among {', '.join(known)}, got {unknown.pop()}")
            runs += [
                (args.task, algorithm, name, seed)
                for seed in args.seeds
                for name in args.policies or known
            ]
    for task, algorithm, name, seed in tqdm([run for run in runs if run not in done]):
        found = training.train(TASKS[task], algorithm, name, seed, args.episodes)
        rows = [(task, algorithm, name, seed, *row) for row in found]
        table = pd.concat([tables.get(args.csv[0]), pd.DataFrame(rows, columns=COLUMNS)])
        with replacing(args.csv[0]) as draft:
            table.to_csv(draft, index=False)
        tables[args.csv[0]] = table
    table = pd.concat(tables.values())
    print(rule.summary(table))
    if args.figure is not None:
        rule.save_figure(table, args.figure)


if __name__ == "__main__":
    from sb3_flowpolicy.common.command_line import run

    run(main)
