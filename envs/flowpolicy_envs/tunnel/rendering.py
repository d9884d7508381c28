"""Pictures of the Tunnel."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flowpolicy_envs.canvas import WHITE, Canvas
from flowpolicy_envs.tunnel.config import TunnelConfig
from flowpolicy_envs.tunnel.kernels import LINE, SPLINE

if TYPE_CHECKING:
    import pygame

_WALL = (214, 39, 40)
_GOAL = (120, 200, 120)
_REACH = (170, 170, 170)
_TRAIL = (150, 150, 150)
_AGENT = (0, 0, 0)
_SAMPLE = (31, 119, 220, 110)

_LANE = 0.05
"""Half the width at which a one-dimensional world is drawn."""


class Renderer(Canvas):
    """Draws the first two dimensions of a Tunnel; a one-dimensional world becomes a lane.

    Red lines are walls, green is the goal region, the black disc is the agent, the gray box its
    reach, the gray dots its past positions, and the blue dots the positions to which sampled
    actions would lead.

    Args:
        config: The tunnel.
        size: Edge of a frame in pixels, at least 16.

    Raises:
        ValueError: If `size` is not an integer of at least 16.

    Example:
        >>> Renderer(TunnelConfig(), size=64).frame(np.zeros((1, 2))).shape
        (64, 64, 3)
    """

    caption = "Tunnel"

    def __init__(self, config: TunnelConfig, size: int) -> None:
        super().__init__(size)
        self._config = config

    def _draw(
        self,
        canvas: "pygame.Surface",
        trail: NDArray[np.float64],
        samples: NDArray[np.float64] | None = None,
    ) -> None:
        """Draw the agent.

        Args:
            canvas: Surface to draw on.
            trail: Positions (T, D) of this episode, T >= 1; the agent is at the last one.
            samples: Actions (N, D) to draw around the agent.
        """
        import pygame

        line = self._pixels(0.005)
        visited = self._screen(trail)
        reach = self._config.reach * self._scale
        x, y = visited[-1]
        box = pygame.Rect(round(x - reach), round(y - reach), round(2 * reach), round(2 * reach))
        pygame.draw.rect(canvas, _REACH, box, width=line)
        if len(visited) > 1:
            pygame.draw.lines(canvas, _TRAIL, False, visited.tolist(), width=line)
        for point in visited[:-1].tolist():
            pygame.draw.circle(canvas, _TRAIL, point, 2 * line)
        if samples is not None:
            targets = trail[-1] + self._config.reach * np.clip(samples, -1.0, 1.0)
            self._dots(canvas, _SAMPLE, 0.012, np.clip(targets, -1.0, 1.0))
        pygame.draw.circle(canvas, _AGENT, (x, y), self._pixels(0.018))

    def _draw_background(self, canvas: "pygame.Surface") -> None:
        canvas.set_clip(self._world())
        self._draw_tunnel(canvas)
        canvas.set_clip(None)

    def _draw_tunnel(self, canvas: "pygame.Surface") -> None:
        config, path = self._config, self._config.geometry
        half_width, wall = config.width / 2.0, self._pixels(0.008) / self._scale
        if config.total_dims == 1:
            half_width, wall = _LANE, 0.0
        elif path.kind == LINE and config.total_dims - config.free_dims == 1:
            # The second dimension is free.
            half_width, wall = self.view, 0.0
        center = path.polyline(*path.ends)
        # A narrow white band on top of a wide red one leaves the walls.
        self._draw_band(canvas, _WALL, center, half_width + wall)
        self._draw_band(canvas, WHITE, center, half_width)
        goal = path.polyline(*path.goal_arcs)
        rounded = slice(-1, None) if path.kind == SPLINE else slice(0)
        self._draw_band(canvas, _GOAL, goal, half_width, rounded)

    def _draw_band(
        self,
        canvas: "pygame.Surface",
        color: tuple[int, int, int],
        center: NDArray[np.float64],
        half_width: float,
        rounded: slice = slice(None),
    ) -> None:
        """Fill the band within `half_width` of the polyline `center` (K, D).

        Joints and ends are rounded at the points that `rounded` selects and straight elsewhere.
        """
        import pygame

        if len(center) < 2:  # a goal at the border of the world has no extent
            return
        points = self._screen(center)
        radius = half_width * self._scale
        along = np.gradient(points, axis=0)
        # At a hairpin the directions cancel; the rounded joint covers the turn.
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
        across = radius * np.column_stack([-along[:, 1], along[:, 0]])
        left, right = points + across, points - across
        for k in range(len(points) - 1):
            corners = [left[k], left[k + 1], right[k + 1], right[k]]
            pygame.draw.polygon(canvas, color, corners)
        for joint in points[rounded]:
            pygame.draw.circle(canvas, color, joint, radius)
