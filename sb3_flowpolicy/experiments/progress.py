"""A progress bar over the environment steps of all items, with the time left."""

from __future__ import annotations

import queue
from collections.abc import Sequence
from typing import Any

from tqdm import tqdm

from sb3_flowpolicy.experiments.work import WorkItem


class Progress:
    """Counts the environment steps of all seeds and names the items at work.

    Args:
        items: All items.
        finished: Keys of those that were finished before this run.
        shown: Whether to draw the bar.
    """

    def __init__(
        self, items: Sequence[WorkItem], finished: Sequence[str] = (), shown: bool = True
    ) -> None:
        self.items = {item.key: item for item in items}
        self.steps = {key: self.items[key].steps for key in finished}
        self.bar = tqdm(
            total=sum(item.steps * len(item.seeds) for item in items),
            initial=sum(item.steps * len(item.seeds) for item in items if item.key in finished),
            desc="all",
            unit=" steps",
            unit_scale=True,
            disable=not shown,
            dynamic_ncols=True,
        )

    def update(self, key: str, steps: int) -> None:
        """Note that each seed of an item has done so many steps."""
        item, known = self.items[key], key in self.steps
        steps = min(steps, item.steps)
        gained = (steps - self.steps.get(key, 0)) * len(item.seeds)
        self.steps[key] = steps
        if not known and not self.bar.disable:
            self.bar.initial += gained  # an earlier session's steps are no measure of this speed
        shares = {name: done / self.items[name].steps for name, done in self.steps.items()}
        at_work = (f"{name} {share:.0%}" for name, share in shares.items() if share < 1)
        self.bar.set_postfix_str(", ".join(at_work), False)
        self.bar.update(gained)

    def take(self, reports: Any) -> None:
        """Note all reports of a queue: pairs of an item's key and its steps."""
        while True:
            try:
                self.update(*reports.get_nowait())
            except queue.Empty:
                return

    def close(self) -> None:
        """Close the bar."""
        self.bar.close()
