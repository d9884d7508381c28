"""Results of an experiment as rows of text, for the page and for Markdown."""

from __future__ import annotations

from dataclasses import dataclass

from sb3_flowpolicy.common.statistics import Estimate, interquartile_mean
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.store import commits_of
from sb3_flowpolicy.experiments.work import FIRST_SEED

WORDS = {
    "train_return": "training return",
    "train_success": "training success",
    "test_return": "test return",
    "test_success": "test success",
    "entropy": "entropy",
    "ent_coef": "entropy coefficient",
    "same_axis_correlation": "correlation of same-axis actions",
    "x_std": "standard deviation of x",
    "x_max": "greatest distance along x",
}
"""Names of metrics in sentences."""

_DECIMALS = {"ent_coef": 4, "x_std": 3, "x_max": 3}


@dataclass(frozen=True)
class Table:
    """Head and rows of text."""

    head: list[str]
    rows: list[list[str]]

    def markdown(self) -> str:
        """Return the table as Markdown."""
        lines = [self.head, ["---"] * len(self.head), *self.rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def in_digits(metric: str, estimate: Estimate) -> str:
    """Format an estimate with the digits that suit its metric."""
    return f"{estimate:.{_DECIMALS.get(metric, 2)}f}"


_METRICS = ("train_return", "train_success", "test_return", "test_success", "entropy", "ent_coef")


def results_table(evidence: Evidence) -> Table:
    """Return final values of every agent on every setting, with counts of seeds that solved it."""
    measured = evidence.measured
    known = {name for s, a in measured for name in evidence.columns(s.name, a.name)}
    metrics = [name for name in (*_METRICS, *sorted(known - set(_METRICS))) if name in known]
    counted = "test_success" in known
    head = ["setting", "agent", "seeds"]
    head += ["solved at the end", "at its best", "steps until solved"] if counted else []
    head += [WORDS.get(name, name) for name in metrics]
    rows = []
    for setting, agent in measured:
        columns = evidence.columns(setting.name, agent.name)
        _, values = evidence.curves(setting.name, agent.name, columns[0])
        row = [setting.name, agent.label, str(len(values))]
        if counted:
            row += _counts(evidence, setting.name, agent.name)
        for name in metrics:
            if name in columns:
                final = interquartile_mean(evidence.final(setting.name, agent.name, name))
                row.append(in_digits(name, final))
            else:
                row.append("-")
        rows.append(row)
    return Table(head, rows)


def _counts(evidence: Evidence, setting: str, agent: str) -> list[str]:
    if "test_success" not in evidence.columns(setting, agent):
        return ["-"] * 3
    solved, once = evidence.solved(setting, agent), evidence.solved_once(setting, agent)
    steps = interquartile_mean(evidence.steps_until_solved(setting, agent))
    return [
        f"{solved.sum()} of {len(solved)}",
        f"{once.sum()} of {len(once)}",
        f"{steps:,.0f}" if once.any() else "never",
    ]


def facts(evidence: Evidence) -> dict[str, str]:
    """Return the origin of the results: command, seeds, cost, commit, machine."""
    done = [one for one in evidence.done.values() if one]
    seeds, steps = evidence.seeds, evidence.settings.get("steps", evidence.experiment.steps)
    command = f"python -m sb3_flowpolicy.experiments run {evidence.experiment.name}"
    if steps != evidence.experiment.steps:
        command += f" --steps {steps}"
    if seeds and len(seeds) != evidence.experiment.seeds:
        command += f" --seeds {len(seeds)}"
    if seeds and seeds[0] != FIRST_SEED:
        command += f" --first-seed {seeds[0]}"
    found = {"command": command}
    if not evidence.items:
        return found
    found["seeds"] = f"{seeds[0]} to {seeds[-1]}, {steps:,} steps each"
    found["items"] = f"{len(done)} of {len(evidence.items)} finished"
    if done:
        machine = done[-1]["machine"]
        hours = sum(one["cpu_seconds"] for one in done) / 3600
        speeds = [one["steps_per_second"] for one in done]
        found["cost"] = (
            f"{hours:.2f} core hours; {min(speeds):,.0f} to {max(speeds):,.0f} steps per second "
            "and process, seeds summed"
        )
        found["commit"] = ", ".join(
            sorted({str(commit) for one in done for commit in commits_of(one)})
        )
        versions = machine["versions"]
        found["machine"] = (
            f"{machine['cpu_count']} cores {machine['processor']}, Python {machine['python']}, "
            + ", ".join(f"{k} {versions[k]}" for k in ("torch", "stable_baselines3", "gymnasium"))
        )
    return found
