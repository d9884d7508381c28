"""Progress bars: one for the experiment with its time left, one per item at work."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType

from tqdm import tqdm

from sb3_flowpolicy.experiments.work import WorkItem


class Progress:
    """Shows how far the items of a run are, counted in environment steps of all seeds.

    Args:
        items: All items.
        finished: Keys of those that were finished before this run.
        shown: Whether to draw bars.
    """

    def __init__(
        self, items: Sequence[WorkItem], finished: Sequence[str] = (), shown: bool = True
    ) -> None:
        self.items = {item.key: item for item in items}
        self.steps = {item.key: item.steps if item.key in finished else 0 for item in items}
        self.seen: set[str] = set()
        self.shown = shown
        self.bars: dict[str, tqdm] = {}
        self.lines: dict[str, int] = {}
        count = sum(item.steps * len(item.seeds) for item in items)
        self.total = self._bar("all", count, 0, sum(self._weight(key) for key in finished))

    def _bar(self, name: str, total: int, position: int, initial: int = 0) -> tqdm:
        return tqdm(
            total=total,
            initial=initial,
            desc=name,
            unit=" steps",
            unit_scale=True,
            position=position,
            leave=position == 0,
            disable=not self.shown,
            dynamic_ncols=True,
        )

    def _weight(self, key: str) -> int:
        return self.steps[key] * len(self.items[key].seeds)

    def update(self, key: str, steps: int) -> None:
        """Note that each seed of an item has done so many steps."""
        before = self._weight(key)
        self.steps[key] = min(steps, self.items[key].steps)
        gained = self._weight(key) - before
        if key not in self.seen:
            self.seen.add(key)
            if self.steps[key] < self.items[key].steps:
                taken = self.lines.values()
                self.lines[key] = next(k for k in range(1, len(taken) + 2) if k not in taken)
                item = self.items[key]
                self.bars[key] = self._bar(key, item.steps * len(item.seeds), self.lines[key])
            # Steps of an earlier session say nothing about the speed of this one.
            if self.shown:
                self.total.initial += gained
        self.total.update(gained)
        bar = self.bars.get(key)
        if bar is not None:
            bar.update(gained)
            if self.steps[key] >= self.items[key].steps:
                bar.close()
                del self.bars[key], self.lines[key]

    def __enter__(self) -> Progress:
        """Start."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close all bars."""
        for bar in (*self.bars.values(), self.total):
            bar.close()
