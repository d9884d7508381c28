"""How long an experiment takes here, from a table of measured speeds."""

from __future__ import annotations

from sb3_flowpolicy.experiments.work import Plan, WorkItem

STEPS_PER_SECOND = {
    16: {"sac_gauss": 3300.0, "sac_lowrank": 2450.0, "sac_flow": 2400.0},
    128: {"sac_gauss": 390.0, "sac_lowrank": 370.0, "sac_flow": 340.0},
    256: {"sac_gauss": 105.0, "sac_lowrank": 103.0, "sac_flow": 99.0},
}
"""Units of the critics' layers -> agent -> steps per second, summed over ten seeds of one process
with one thread, on one of two idle cores of an AMD EPYC (docs/benchmarks.md).

16: ``learn()`` of ten seeds; for sac_lowrank, sac_gauss's rate times their ratio as single agents.
128 and 256: updates of single agents, as ten seeds gain nothing where matrix products are the
limit. All blocks do one update per step, which is what takes the time. What a run really took is in
its ``.done.json`` files.
"""

GSDE_STEPS_PER_SECOND = 250.0
"""gSDE runs in SB3's own loop, one seed after the other, whatever the size of small networks."""

_START_SECONDS = 40
"""Starting a process and compiling."""


def item_seconds(item: WorkItem) -> float:
    """Estimate the time of an item on one core, seconds."""
    settings = item.hyperparameters
    net_arch = settings.get("policy_kwargs", {}).get("net_arch", [256, 256])
    critic = net_arch["qf"] if isinstance(net_arch, dict) else net_arch
    width = min(STEPS_PER_SECOND, key=lambda known: abs(known - max(critic)))
    algo = {"GaussPolicy": "sac_gauss", "LowRankPolicy": "sac_lowrank"}.get(
        settings["policy"], "sac_flow"
    )
    speed = STEPS_PER_SECOND[width][algo]
    if settings.get("use_sde"):
        speed = min(speed, GSDE_STEPS_PER_SECOND)
    return _START_SECONDS + item.steps * len(item.seeds) / speed


def plan_seconds(plan: Plan, workers: int) -> float:
    """Estimate the time of a plan: the longest items first, each to whoever is free."""
    loads = [0.0] * max(1, workers)
    for seconds in sorted((item_seconds(item) for item in plan.items), reverse=True):
        loads[loads.index(min(loads))] += seconds
    return max(loads)


def in_words(seconds: float) -> str:
    """Return a time as people say it.

    Example:
        >>> in_words(95), in_words(5000), in_words(200_000)
        ('2 min', '1.4 h', '2.3 days')
    """
    if seconds < 3600:
        return f"{max(1, round(seconds / 60))} min"
    return f"{seconds / 3600:.1f} h" if seconds < 86_400 else f"{seconds / 86_400:.1f} days"
