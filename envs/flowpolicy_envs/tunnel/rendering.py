"""Pictures of the Tunnel."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flowpolicy_envs.tunnel.config import TunnelConfig
from flowpolicy_envs.tunnel.kernels import LINE, SPLINE

if TYPE_CHECKING:
    import pygame

RENDER_MODES = ("human", "rgb_array")
RENDER_FPS = 10

_WHITE = (255, 255, 255)
_BORDER = (60, 60, 60)
_WALL = (214, 39, 40)
_GOAL = (120, 200, 120)
_REACH = (170, 170, 170)
_TRAIL = (150, 150, 150)
_AGENT = (0, 0, 0)
_SAMPLE = (31, 119, 220, 110)

_VIEW = 1.04
"""Half the edge of the picture in world units: the world and a small margin."""

_LANE = 0.05
"""Half the width at which a one-dimensional world is drawn."""

_SUPERSAMPLING = 3
"""Shapes are drawn this much larger and scaled down, which smooths their edges."""


def check_render_mode(render_mode: str | None, modes: tuple[str, ...]) -> None:
    """Raise ValueError unless `render_mode` is None or one of `modes`."""
    if render_mode is not None and render_mode not in modes:
        raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}")


class Renderer:
    """Draws the first two dimensions of a Tunnel; a one-dimensional world becomes a lane.

    Red lines are walls, green is the goal region, the black disc is the agent, the grey box its
    reach, the grey dots where it has been. Blue dots are where sampled actions would lead.

    Args:
        config: The tunnel.
        size: Edge of a frame in pixels, at least 16.

    Raises:
        ValueError: If `size` is not an integer of at least 16.

    Example:
        >>> Renderer(TunnelConfig(), size=64).frame(np.zeros((1, 2))).shape
        (64, 64, 3)
    """

    def __init__(self, config: TunnelConfig, size: int) -> None:
        if not isinstance(size, int | np.integer) or size < 16:
            raise ValueError(f"render_size must be an integer of at least 16, got {size!r}")
        self._config = config
        self._size = size
        self._scale = size * _SUPERSAMPLING / (2.0 * _VIEW)
        self._background: pygame.Surface | None = None
        self._window: pygame.Surface | None = None
        self._clock: Any = None

    def __getstate__(self) -> dict[str, Any]:
        # Surfaces and windows can neither be copied nor pickled; they are drawn again on demand.
        return {**self.__dict__, "_background": None, "_window": None, "_clock": None}

    def frame(
        self, trail: NDArray[np.float64], samples: NDArray[np.float64] | None = None
    ) -> NDArray[np.uint8]:
        """Return the picture.

        Args:
            trail: Positions (T, D) of this episode, T >= 1; the agent is at the last one.
            samples: Actions (N, D) to draw around it.

        Returns:
            Colours (size, size, 3), 0 to 255.
        """
        import pygame

        pixels = pygame.surfarray.array3d(self._draw(trail, samples))
        return np.ascontiguousarray(pixels.transpose(1, 0, 2))

    def show(self, trail: NDArray[np.float64], samples: NDArray[np.float64] | None = None) -> None:
        """Show the picture in a window, and wait as the frame rate asks for."""
        import pygame

        if self._window is None:
            pygame.display.init()
            pygame.display.set_caption("Tunnel")
            self._window = pygame.display.set_mode((self._size, self._size))
            self._clock = pygame.time.Clock()
        self._window.blit(self._draw(trail, samples), (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(RENDER_FPS)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            import pygame

            pygame.display.quit()
            self._window = None

    def _draw(
        self, trail: NDArray[np.float64], samples: NDArray[np.float64] | None
    ) -> "pygame.Surface":
        import pygame

        if self._background is None:
            self._background = self._draw_background()
        canvas = self._background.copy()
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
            self._draw_samples(canvas, trail[-1], samples)
        pygame.draw.circle(canvas, _AGENT, (x, y), self._pixels(0.018))
        return pygame.transform.smoothscale(canvas, (self._size, self._size))

    def _draw_samples(
        self, canvas: "pygame.Surface", position: NDArray[np.float64], samples: NDArray[np.float64]
    ) -> None:
        import pygame

        radius = self._pixels(0.012)
        dot = pygame.Surface((2 * radius + 1, 2 * radius + 1), pygame.SRCALPHA, 32)
        pygame.draw.circle(dot, _SAMPLE, (radius, radius), radius)
        targets = position + self._config.reach * np.clip(samples, -1.0, 1.0)
        corners = self._screen(np.clip(targets, -1.0, 1.0)) - radius
        canvas.blits([(dot, corner) for corner in corners.tolist()])

    def _draw_background(self) -> "pygame.Surface":
        """Draw all that does not move."""
        import pygame

        edge = self._size * _SUPERSAMPLING
        # A depth of 32 bits is given so that no display has to be asked for its own.
        canvas = pygame.Surface((edge, edge), 0, 32)
        canvas.fill(_WHITE)
        low, high = self._screen(np.array([[-1.0, 1.0], [1.0, -1.0]])).round()
        world = pygame.Rect(*low, *(high - low))
        canvas.set_clip(world)
        self._draw_tunnel(canvas)
        canvas.set_clip(None)
        pygame.draw.rect(canvas, _BORDER, world, width=self._pixels(0.006))
        return canvas

    def _draw_tunnel(self, canvas: "pygame.Surface") -> None:
        config, path = self._config, self._config.geometry
        half_width, wall = config.width / 2.0, self._pixels(0.008) / self._scale
        if config.total_dims == 1:
            half_width, wall = _LANE, 0.0
        elif path.kind == LINE and config.total_dims - config.free_dims == 1:
            # The second dimension drawn is free: nothing confines it.
            half_width, wall = _VIEW, 0.0
        centre = path.polyline(*path.ends)
        # A wide red band with a narrower white one on top leaves exactly the walls.
        self._draw_band(canvas, _WALL, centre, half_width + wall)
        self._draw_band(canvas, _WHITE, centre, half_width)
        goal = path.polyline(*path.goal_arcs)
        self._draw_band(
            canvas,
            _GOAL,
            goal,
            half_width,
            rounded=slice(-1, None) if path.kind == SPLINE else slice(0),
        )

    def _draw_band(
        self,
        canvas: "pygame.Surface",
        colour: tuple[int, int, int],
        centre: NDArray[np.float64],
        half_width: float,
        rounded: slice = slice(None),
    ) -> None:
        """Fill what lies within `half_width` of the polyline `centre` (K, D).

        Joints and ends are rounded at the points that `rounded` selects, others cut off straight.
        """
        import pygame

        if len(centre) < 2:  # A goal at the very border of the world has no extent.
            return
        points = self._screen(centre)
        radius = half_width * self._scale
        along = np.gradient(points, axis=0)
        # At a hairpin the directions cancel; the rounded joint covers the turn.
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
        across = radius * np.column_stack([-along[:, 1], along[:, 0]])
        left, right = points + across, points - across
        for k in range(len(points) - 1):
            corners = [left[k], left[k + 1], right[k + 1], right[k]]
            pygame.draw.polygon(canvas, colour, corners)
        for joint in points[rounded]:
            pygame.draw.circle(canvas, colour, joint, radius)

    def _screen(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map positions (N, D) to pixels (N, 2) of the canvas; the second axis points up."""
        x = positions[:, 0]
        y = positions[:, 1] if positions.shape[1] > 1 else np.zeros_like(x)
        return self._scale * np.column_stack([_VIEW + x, _VIEW - y])

    def _pixels(self, length: float) -> int:
        return max(1, round(length * self._scale))
