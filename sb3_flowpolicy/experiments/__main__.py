"""`python -m sb3_flowpolicy.experiments`: rerun the thesis's findings and judge them."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from pathlib import Path

from sb3_flowpolicy.common.command_line import HelpFormatter, assignment, at_least
from sb3_flowpolicy.experiments import work
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS, what_is_missing
from sb3_flowpolicy.experiments.runner import Progress, results_folder, run_local, unfinished

OUT = {"full": Path("logs/experiments"), "quick": Path("logs/experiments-quick")}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status, 1 after an error, 130 if interrupted."""
    args = _parser().parse_args(arguments)
    try:
        args.command(args)
    except KeyboardInterrupt:
        print(
            "\nInterrupted. The same command continues from the last checkpoint.", file=sys.stderr
        )
        return 130
    except (OSError, ValueError, RuntimeError, ModuleNotFoundError) as error:
        advice = (
            ". Finished items are kept; once this is fixed, the same command continues from the "
            "last checkpoint"
        )
        broken = isinstance(error, OSError) and args.command is _run
        print(f"error: {error}{advice if broken else ''}", file=sys.stderr)
        return 1
    return 0


def _list(args: argparse.Namespace) -> None:
    line = "{:<22}{:<7}{:>6}{:>9}{:>11}{:>6}{:>12}  {}"
    head = ("experiment", "claim", "agents", "settings", "steps", "seeds", "in all")
    print(line.format(*head, "what it compares"))
    for one in EXPERIMENTS.values():
        missing, plan = what_is_missing(one), work.make_plan(one, args.profile)
        sizes = len(one.agents), len(one.settings), f"{plan.steps:,}", len(plan.seeds)
        total = f"{sum(item.all_steps for item in plan.items):,}"
        needs = f" [needs {missing}]" if missing else ""
        print(line.format(one.name, one.claim, *sizes, total, one.title + needs))


def _run(args: argparse.Namespace) -> None:
    experiment = work.vary(EXPERIMENTS[args.name], dict(args.set), args.agents)
    missing = what_is_missing(experiment)
    if missing:
        raise ValueError(f"{experiment.name} needs {missing}, which is not installed")
    if args.address is not None and args.backend != "ray":
        raise ValueError(f"--address needs --backend ray, got {args.backend!r}")
    plan = work.make_plan(
        experiment, args.profile, args.steps, args.seeds, args.first_seed, args.seeds_per_item
    )
    out = args.out or OUT[args.profile]
    with results_folder(out, plan) as folder:
        items = unfinished(folder, plan)
        finished = {item.key for item in plan.items} - {item.key for item in items}
        print(
            f"{experiment.name} ({experiment.claim}): {len(plan.items)} items of {plan.steps:,} "
            f"steps x {len(plan.items[0].seeds)} seeds, {len(finished)} finished before"
            + (f", {args.workers} at a time" if args.backend == "local" else "")
            + f"\nResults: {folder}"
        )
        if items:
            with Progress(plan.items, finished, shown=not args.no_progress) as progress:
                if args.backend == "ray":
                    from sb3_flowpolicy.experiments.ray_backend import run_on_ray

                    run_on_ray(folder, items, progress, args.address)
                else:
                    run_local(folder, items, progress, args.workers)
        shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    print(f"Finished. python -m sb3_flowpolicy.experiments report --results {out}")


def _report(args: argparse.Namespace) -> None:
    from sb3_flowpolicy.experiments.report import read_results, write_docs, write_report

    if args.html is not None and args.html.is_dir():
        raise ValueError(f"--html must be a file, got the folder {args.html}")
    sections, page = read_results(args.results), args.html or args.results / "report.html"
    write_report(sections, page)
    print(f"Report: {page}")
    if args.docs is not None:
        print(f"Tables, figures and data: {write_docs(sections, args.docs)}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.experiments",
        description="The findings of the thesis, each by one command: `list` shows them, `run` "
        "trains the agents, `report` draws and judges the results.",
    )
    commands = parser.add_subparsers(required=True, metavar="list|run|report")
    show, run, report = (
        commands.add_parser(name, help=text, description=text, formatter_class=HelpFormatter)
        for name, text in (
            ("list", "Show all experiments, their cost and whether they can run here."),
            ("run", "Run one experiment, or continue it after an interruption."),
            ("report", "Write one HTML page from all results, and the tables for the docs."),
        )
    )
    show.set_defaults(command=_list)
    run.set_defaults(command=_run)
    report.set_defaults(command=_report)
    add, count = run.add_argument, at_least(1)
    add("name", metavar="NAME", choices=EXPERIMENTS, help="experiment; `list` shows them")
    seeds = f"number of seeds (default: the experiment's; quick: {work.QUICK_SEEDS})"
    add("--seeds", type=count, help=seeds)
    first = "1 for results, 100 for tuning"
    add("--first-seed", type=at_least(0), default=work.FIRST_SEED, help=first)
    steps = f"steps per seed (default: the experiment's; quick: {work.QUICK_STEPS})"
    add("--steps", type=count, help=steps)
    add("--agents", nargs="+", metavar="AGENT", help="only these agents")
    values = "arguments of all environments, for tuning (YAML values)"
    add("--set", nargs="*", type=assignment, default=[], metavar="ARG=VALUE", help=values)
    add("--backend", choices=("local", "ray"), default="local", help="where to run")
    add("--address", help="Ray cluster to join, 'auto' for the one this machine is in")
    outs = " or ".join(map(str, OUT.values()))
    add("--out", type=Path, help=f"folder for results (default: {outs}, by profile)")
    together = "seeds trained together in a process; fewer spread over more machines"
    add("--seeds-per-item", type=count, default=work.SEEDS_PER_ITEM, help=together)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    workers = "processes at a time, one core each"
    add("--workers", type=count, default=cores, help=workers)
    add("--no-progress", action="store_true", help="show no progress bars")
    for command in (show, run):
        quick = "quick: two seeds and few steps, to check that everything works"
        command.add_argument("--profile", choices=("full", "quick"), default="full", help=quick)
    add = report.add_argument
    add("--results", type=Path, default=OUT["full"], help="folder that `run` wrote")
    add("--html", type=Path, help="page to write (default: report.html in it)")
    add("--docs", type=Path, help="also write Markdown, PNG figures and data there")
    return parser


if __name__ == "__main__":
    sys.exit(main())
