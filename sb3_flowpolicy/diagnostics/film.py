"""Episodes as frames, videos and sequences of pictures (thesis Fig. 3.19)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_flowpolicy.diagnostics.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def episode_frames(
    model: BaseAlgorithm, env: VecEnv, n_samples: int = 300, deterministic: bool = False
) -> list[np.ndarray]:
    """Play one episode and return its pictures, the policy's action samples drawn in.

    Args:
        model: Any SB3 model.
        env: One environment, vectorised, with the render mode ``rgb_array`` and a method
            ``set_action_samples``, as those of ``flowpolicy_envs`` have.
        n_samples: Number of action samples drawn at each step, from the policy as it acts there.
        deterministic: Whether to act without exploration; the samples are drawn all the same.

    Returns:
        One picture (size, size, 3) per step, each before the action it leads to.

    Raises:
        ValueError: If there is more than one environment, or it cannot show action samples.
    """
    if env.num_envs != 1:
        raise ValueError(f"env must hold one environment, got {env.num_envs}")
    if not env.has_attr("set_action_samples"):
        raise ValueError("env must have a method set_action_samples, got none")
    frames = []
    obs, done = env.reset(), np.array([False])
    while not done[0]:
        assert isinstance(obs, np.ndarray)
        samples, _ = model.predict(np.repeat(obs, n_samples, axis=0))
        env.env_method("set_action_samples", samples)
        frame = env.render(mode="rgb_array")
        assert frame is not None
        frames.append(frame)
        action, _ = model.predict(obs, deterministic=deterministic)
        obs, _, done, _ = env.step(action)
    return frames


def sequence_figure(frames: Sequence[np.ndarray], first: int, n_steps: int) -> Figure:
    """Put pictures of consecutive steps side by side.

    Args:
        frames: Pictures of one episode.
        first: Step of the first picture, counted from 0.
        n_steps: Number of pictures.

    Returns:
        A matplotlib figure.

    Raises:
        ValueError: If the episode has no such steps.
    """
    if n_steps < 1 or not 0 <= first <= len(frames) - n_steps:
        raise ValueError(
            f"first and n_steps must lie within the episode's {len(frames)} steps, "
            f"got {first} and {n_steps}"
        )
    figure = new_figure(2.4 * n_steps, 2.6)
    for k, axes in enumerate(figure.subplots(1, n_steps, squeeze=False)[0]):
        axes.imshow(frames[first + k])
        axes.set_title(f"step {first + k}", fontsize=9)
        axes.set_axis_off()
    return figure


def write_video(frames: Sequence[np.ndarray], path: Path, fps: float) -> None:
    """Write pictures as an MP4.

    Args:
        frames: Pictures (H, W, 3) of the same size.
        path: Where to; must end in ``.mp4``.
        fps: Pictures per second.

    Raises:
        ValueError: If there are no pictures, or the path does not end in ``.mp4``.
        ModuleNotFoundError: If moviepy is missing, with what to install.
    """
    if not frames or path.suffix != ".mp4":
        raise ValueError(f"path must end in .mp4 and frames not be empty, got {path}")
    try:
        from moviepy import ImageSequenceClip
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'videos need moviepy: pip install "sb3_flowpolicy[zoo]"'
        ) from error
    draft = path.with_name(f"{path.stem}.part.mp4")
    ImageSequenceClip(list(frames), fps=fps).write_videofile(str(draft), logger=None)
    draft.replace(path)
