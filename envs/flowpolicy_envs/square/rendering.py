"""Pictures of the Square (thesis Fig. 3.12 and 3.13)."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flowpolicy_envs.canvas import BORDER, WHITE, Canvas
from flowpolicy_envs.square import kernels
from flowpolicy_envs.square.batch import END_REASONS, SquareBatch
from flowpolicy_envs.square.config import SquareConfig
from flowpolicy_envs.square.tasks import FindGoal

if TYPE_CHECKING:
    import pygame

RENDER_FPS = 4
"""The frequency of the agent, so that pictures show real time."""

COLORS = ((214, 39, 40), (31, 119, 180), (44, 150, 44), (230, 130, 14))
"""Colors of the fingers: right, top, left, bottom."""

_SQUARE = (25, 25, 25)
_TEXT = (60, 60, 60)
_HELD = (40, 180, 70)
_LOOSE = (205, 205, 205)
_FAILED = (214, 39, 40)
_GOAL = (120, 200, 120)
_REGION = (222, 240, 222)


class Renderer(Canvas):
    """Draws one Square of a batch.

    The square is black, with a white mark that shows its orientation. Fingers are discs; boxes in
    their colors show their reach, rings their targets, small dots the targets of sampled actions.
    The lamp at the top right is green while the square is held; the bar below it shows the holding
    force, with a line at the force that the weight requires. Green on the diagonal: the hidden goal
    and the region from which it was drawn.

    Args:
        config: The rules.
        size: Edge of a frame in pixels, at least 16.

    Raises:
        ValueError: If `size` is not an integer of at least 16.

    Example:
        >>> batch = SquareBatch(SquareConfig(), count=1)
        >>> batch.reset(batch.everyone, np.random.default_rng)
        >>> Renderer(batch.config, size=64).frame(batch, 0).shape
        (64, 64, 3)
    """

    caption = "Square"
    fps = RENDER_FPS

    def __init__(self, config: SquareConfig, size: int) -> None:
        super().__init__(size)
        self._config = config

    def _draw_background(self, canvas: "pygame.Surface") -> None:
        import pygame

        task = self._config.task
        if isinstance(task, FindGoal):
            ends = self._screen(np.array([[-task.span] * 2, [task.span] * 2]))
            radius = task.radius * self._scale
            along = (ends[1] - ends[0]) / max(np.linalg.norm(ends[1] - ends[0]), 1e-12)
            across = radius * np.array([-along[1], along[0]])
            band = [ends[0] - across, ends[1] - across, ends[1] + across, ends[0] + across]
            pygame.draw.polygon(canvas, _REGION, band)
            for end in ends:
                pygame.draw.circle(canvas, _REGION, end, radius)

    def _draw(
        self,
        canvas: "pygame.Surface",
        batch: SquareBatch,
        i: int,
        samples: NDArray[np.float64] | None = None,
    ) -> None:
        """Draw world i of `batch`, with action samples (N, 8)."""
        self._draw_square(canvas, batch, i)
        if samples is not None:
            self._draw_samples(canvas, batch, i, samples)
        self._draw_fingers(canvas, batch, i)
        self._draw_lamp(canvas, batch, i)
        self._draw_text(canvas, batch, i)

    def _draw_square(self, canvas: "pygame.Surface", batch: SquareBatch, i: int) -> None:
        import pygame

        x, y, angle = batch.bodies[i, :3]
        half = batch.constants[i, kernels.HALF_SIDE]
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        local = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [0, 0], [0, 0.8]])
        points = self._screen(local @ turn + (x, y))
        pygame.draw.polygon(canvas, _SQUARE, points[:4])
        pygame.draw.line(canvas, WHITE, points[4], points[5], self._pixels(0.008))
        pygame.draw.circle(canvas, WHITE, points[4], self._pixels(0.012))
        task = self._config.task
        if isinstance(task, FindGoal):
            goal = self._screen(batch.goals[[i]])[0]
            color = _HELD if batch.found[i] else _GOAL
            pygame.draw.circle(canvas, color, goal, task.radius * self._scale, self._pixels(0.01))

    def _draw_samples(
        self, canvas: "pygame.Surface", batch: SquareBatch, i: int, samples: NDArray[np.float64]
    ) -> None:
        reach = batch.constants[i, kernels.REACH]
        targets = batch.starts[i] + reach * np.clip(samples, -1.0, 1.0).reshape(-1, 4, 2)
        for finger, color in enumerate(COLORS):
            self._dots(canvas, (*color, 150), 0.007, targets[:, finger])

    def _draw_fingers(self, canvas: "pygame.Surface", batch: SquareBatch, i: int) -> None:
        import pygame

        reach = batch.constants[i, kernels.REACH] * self._scale
        starts, targets, fingers = (
            self._screen(points[i]) for points in (batch.starts, batch.targets, batch.fingers)
        )
        line = self._pixels(0.006)
        for k, color in enumerate(COLORS):
            corner = (starts[k] - reach).round()
            box = pygame.Rect(corner[0], corner[1], round(2 * reach), round(2 * reach))
            pygame.draw.rect(canvas, color, box, width=line)
        for k, color in enumerate(COLORS):
            pygame.draw.circle(canvas, WHITE, targets[k], self._pixels(0.022))
            pygame.draw.circle(canvas, color, targets[k], self._pixels(0.018), 2 * line)
            pygame.draw.circle(canvas, WHITE, fingers[k], self._pixels(0.04))
            pygame.draw.circle(canvas, color, fingers[k], self._pixels(0.034))

    def _draw_lamp(self, canvas: "pygame.Surface", batch: SquareBatch, i: int) -> None:
        import pygame

        center = self._screen(np.array([[0.9, 0.9]]))[0]
        color = _HELD if batch.held[i] else _LOOSE
        pygame.draw.circle(canvas, color, center, self._pixels(0.055))
        pygame.draw.circle(canvas, BORDER, center, self._pixels(0.055), self._pixels(0.006))
        constants = batch.constants[i]
        weight = constants[kernels.WEIGHT]
        force = constants[kernels.FRICTION] * batch.presses[i].sum()
        # The full bar is twice the weight.
        filled = min(force / max(2.0 * weight, 1e-12), 1.0)
        left, top = self._screen(np.array([[0.66, 0.8]]))[0]
        width, height = 0.3 * self._scale, 0.035 * self._scale
        pygame.draw.rect(canvas, color, pygame.Rect(left, top, filled * width, height))
        frame = pygame.Rect(left, top, width, height)
        pygame.draw.rect(canvas, BORDER, frame, self._pixels(0.005))
        middle = left + width / 2.0
        pygame.draw.line(canvas, BORDER, (middle, top), (middle, top + height), self._pixels(0.005))

    def _draw_text(self, canvas: "pygame.Surface", batch: SquareBatch, i: int) -> None:
        import pygame

        config, tallies = self._config, batch.tallies[i]
        seconds = tallies[kernels.N_STEPS] * config.dt * config.substeps
        reason = END_REASONS[batch.ends[i]]
        if batch.ends[i] != kernels.GOING_ON:
            state = reason
        elif tallies[kernels.N_STEPS] < config.warm_steps:
            state = f"warm-up {config.warm_up - seconds:.2f} s"
        elif batch.found[i]:
            state = "goal found"
        else:
            state = "held" if batch.held[i] else "loose"
        color = _TEXT if batch.ends[i] == kernels.GOING_ON else _FAILED
        if not pygame.font.get_init():
            pygame.font.init()
        font = pygame.font.Font(None, self._pixels(0.075))
        right, bottom = self._screen(np.array([[0.96, -0.96]]))[0]
        lines = [
            (f"return {tallies[kernels.RETURN]:.1f}", _TEXT),
            (f"{seconds:.2f} s", _TEXT),
            (state, color),
        ]
        for text, ink in lines:
            image = font.render(text, True, ink)
            bottom -= image.get_height()
            canvas.blit(image, (right - image.get_width(), bottom))
