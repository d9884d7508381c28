"""What the pictures of all environments have in common: background, window, scale, smooth edges."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from flowpolicy_envs.checks import is_whole

if TYPE_CHECKING:
    import pygame

RENDER_MODES = ("human", "rgb_array")
RENDER_FPS = 10

WHITE = (255, 255, 255)
BORDER = (60, 60, 60)

_SUPERSAMPLING = 3
"""Pictures are drawn this much larger and scaled down, which smooths the edges."""


def check_render_mode(render_mode: str | None, modes: tuple[str, ...]) -> None:
    """Raise ValueError unless `render_mode` is None or one of `modes`."""
    if render_mode is not None and (not isinstance(render_mode, str) or render_mode not in modes):
        raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}")


class Canvas(ABC):
    """A square picture of the world and its border, in a window or as an array.

    A subclass draws the static part in `_draw_background`, which is called once, and the rest in
    `_draw`.

    Args:
        size: Edge of a frame in pixels, at least 16.

    Raises:
        ValueError: If `size` is not an integer of at least 16.
    """

    caption: ClassVar[str]
    view: ClassVar[float] = 1.04
    """Half the edge of the picture in world units."""
    fps: ClassVar[int] = RENDER_FPS

    def __init__(self, size: int) -> None:
        if not is_whole(size) or size < 16:
            raise ValueError(f"render_size must be an integer of at least 16, got {size!r}")
        self._size = size
        self._edge = size * _SUPERSAMPLING
        self._scale = self._edge / (2.0 * self.view)
        self._background: pygame.Surface | None = None
        self._window: pygame.Surface | None = None
        self._clock: Any = None

    def __getstate__(self) -> dict[str, Any]:
        # Surfaces and windows can be neither copied nor pickled. They are created on demand.
        return {**self.__dict__, "_background": None, "_window": None, "_clock": None}

    @abstractmethod
    def _draw_background(self, canvas: "pygame.Surface") -> None:
        """Draw the static part on a white canvas."""

    @abstractmethod
    def _draw(self, canvas: "pygame.Surface", *scene: Any) -> None:
        """Draw the scene over the background."""

    def frame(self, *scene: Any) -> NDArray[np.uint8]:
        """Return the picture of the scene: RGB values (size, size, 3), 0 to 255."""
        import pygame

        pixels = pygame.surfarray.array3d(self._picture(scene))
        return np.ascontiguousarray(pixels.transpose(1, 0, 2))

    def show(self, *scene: Any) -> None:
        """Show the picture in a window at the frame rate."""
        import pygame

        if self._window is None:
            pygame.display.init()
            pygame.display.set_caption(self.caption)
            self._window = pygame.display.set_mode((self._size, self._size))
            self._clock = pygame.time.Clock()
        self._window.blit(self._picture(scene), (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(self.fps)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            import pygame

            pygame.display.quit()
            self._window = None

    def _picture(self, scene: tuple[Any, ...]) -> "pygame.Surface":
        import pygame

        if self._background is None:
            # Without an explicit depth pygame would ask the display for it.
            self._background = pygame.Surface((self._edge, self._edge), 0, 32)
            self._background.fill(WHITE)
            self._draw_background(self._background)
            pygame.draw.rect(self._background, BORDER, self._world(), width=self._pixels(0.006))
        canvas = self._background.copy()
        self._draw(canvas, *scene)
        return pygame.transform.smoothscale(canvas, (self._size, self._size))

    def _world(self) -> "pygame.Rect":
        import pygame

        low, high = self._screen(np.array([[-1.0, 1.0], [1.0, -1.0]])).round()
        return pygame.Rect(*low, *(high - low))

    def _dots(
        self,
        canvas: "pygame.Surface",
        color: tuple[int, int, int, int],
        radius: float,
        positions: NDArray[np.float64],
    ) -> None:
        """Draw translucent dots at `positions` (N, D), `radius` in world units."""
        import pygame

        pixels = self._pixels(radius)
        dot = pygame.Surface((2 * pixels + 1, 2 * pixels + 1), pygame.SRCALPHA, 32)
        pygame.draw.circle(dot, color, (pixels, pixels), pixels)
        corners = self._screen(positions) - pixels
        canvas.blits([(dot, corner) for corner in corners.tolist()])

    def _screen(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map positions (N, D) to pixels (N, 2) of the canvas; the second axis points up."""
        x = positions[:, 0]
        y = positions[:, 1] if positions.shape[1] > 1 else np.zeros_like(x)
        return self._scale * np.column_stack([self.view + x, self.view - y])

    def _pixels(self, length: float) -> int:
        return max(1, round(length * self._scale))
