"""Results of an experiment as tables of text, for the page and for Markdown."""

from __future__ import annotations

import pandas as pd

from sb3_flowpolicy.common.statistics import Estimate, interquartile_mean
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.work import FIRST_SEED

WORDS = {
    "train_return": "training return",
    "train_success": "training success",
    "test_return": "test return",
    "test_success": "test success",
    "log_prob_return": "test return, most likely action",
    "log_prob_success": "test success, most likely action",
    "entropy": "entropy",
    "ent_coef": "entropy coefficient",
    "same_axis_correlation": "correlation of same-axis actions",
    "x_max": "greatest distance along x",
    "x_std": "standard deviation of x",
}
"""Names of metrics in sentences, in the order of the figures."""

_DECIMALS = {"ent_coef": 4, "x_std": 3, "x_max": 3}


def markdown(table: pd.DataFrame) -> str:
    """Return a table of text as Markdown."""
    lines = [table.columns, ["---"] * len(table.columns), *table.to_numpy()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def in_digits(metric: str, estimate: Estimate) -> str:
    """Format an estimate with the digits that suit its metric."""
    return f"{estimate:.{_DECIMALS.get(metric, 2)}f}"


def results_table(evidence: Evidence) -> pd.DataFrame:
    """Return final values of every agent on every setting, with counts of seeds that solved it."""
    rows = []
    for setting, agent in evidence.measured:
        pair, metrics = (setting.name, agent.name), evidence.columns(setting.name, agent.name)
        row = {"setting": setting.name, "agent": agent.label, "seeds": ""}
        if "test_success" in metrics:
            solved, once = evidence.solved(*pair), evidence.solved_once(*pair)
            steps = interquartile_mean(evidence.steps_until_solved(*pair))
            row["solved at the end"] = f"{solved.sum()} of {len(solved)}"
            row["at its best"] = f"{once.sum()} of {len(once)}"
            if "log_prob_success" in metrics:
                likely = evidence.solved(*pair, "log_prob_success")
                row["by the most likely action"] = f"{likely.sum()} of {len(likely)}"
            row["steps until solved"] = f"{steps:,.0f}" if once.any() else "never"
        for name in metrics:
            final = evidence.final(*pair, name)
            row["seeds"] = str(len(final))
            row[WORDS[name]] = in_digits(name, interquartile_mean(final))
        rows.append(row)
    return pd.DataFrame(rows).fillna("-")


def facts(evidence: Evidence) -> dict[str, str]:
    """Return the origin of the results: command, seeds, cost, commit, machine."""
    experiment, done = evidence.experiment, [one for one in evidence.done.values() if one]
    found = {"command": f"python -m sb3_flowpolicy.experiments run {experiment.name}"}
    if evidence.items:
        steps, seeds = evidence.settings["steps"], evidence.settings["seeds"]
        for option, value, usual in (
            ("steps", steps, experiment.steps),
            ("seeds", len(seeds), experiment.seeds),
            ("first-seed", seeds[0], FIRST_SEED),
        ):
            found["command"] += f" --{option} {value}" if value != usual else ""
        found["seeds"] = f"{seeds[0]} to {seeds[-1]}, {steps:,} steps each"
        found["items"] = f"{len(done)} of {len(evidence.items)} finished"
    if done:
        hours = sum(one["cpu_seconds"] for one in done) / 3600
        speeds = [one["steps_per_second"] for one in done]
        found["cost"] = (
            f"{hours:.2f} core hours; {min(speeds):,.0f} to {max(speeds):,.0f} steps per second "
            "and process, seeds summed"
        )
        # Old results contain only the commit of the last session.
        commits = [one.get("commits", [one["machine"]["commit"]]) for one in done]
        found["commit"] = ", ".join(sorted({str(commit) for each in commits for commit in each}))
        machine = done[-1]["machine"]
        versions = machine["versions"]
        found["machine"] = (
            f"{machine['cpu_count']} cores {machine['processor']}, Python {machine['python']}, "
            + ", ".join(f"{k} {versions[k]}" for k in ("torch", "stable_baselines3", "gymnasium"))
        )
    return found
