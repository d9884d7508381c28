"""Episodes of a trained policy: success rate, pictures (thesis Fig. 3.2, 3.4, 3.19), videos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.diagnostics.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def evaluate_success(
    model: BaseAlgorithm, env: VecEnv, n_episodes: int = 100, deterministic: bool = True
) -> tuple[float, float]:
    """Run episodes and count those that end with ``info["is_success"]``.

    Args:
        model: Any SB3 model.
        env: Vectorized environment whose infos have ``is_success``.
        n_episodes: Number of episodes, at least 1.
        deterministic: Whether to act without exploration.

    Returns:
        Success rate in [0, 1] and mean return.

    Raises:
        ValueError: If the environment does not report ``is_success``.
    """
    outcomes: list[bool] = []

    def note_outcome(local_vars: dict[str, Any], _: dict[str, Any]) -> None:
        if local_vars["done"]:
            info = local_vars["info"]
            if "is_success" not in info:
                raise ValueError('env must report info["is_success"], got none at episode end')
            outcomes.append(bool(info["is_success"]))

    mean_return, _ = evaluate_policy(
        model, env, n_episodes, deterministic=deterministic, callback=note_outcome
    )
    return float(np.mean(outcomes)), float(np.mean(mean_return))


def episode_frames(
    model: BaseAlgorithm, env: VecEnv, n_samples: int = 300, deterministic: bool = False
) -> list[np.ndarray]:
    """Play one episode and render it with the policy's action samples.

    Args:
        model: Any SB3 model.
        env: One vectorized environment with the render mode ``rgb_array`` and a method
            ``set_action_samples``, as those of ``flowpolicy_envs`` have.
        n_samples: Number of action samples drawn at each step, always with exploration.
        deterministic: Whether to act without exploration.

    Returns:
        One picture (size, size, 3) per step, rendered before its action.

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


def rollout_figure(
    model: BaseAlgorithm, env: VecEnv, n_panels: int = 4, n_samples: int = 300
) -> Figure:
    """Draw the policy's action samples at states spread evenly over a deterministic episode.

    Args:
        model: Any SB3 model.
        env: Environment as in :func:`episode_frames`.
        n_panels: Number of states.
        n_samples: Number of action samples at each state.
    """
    frames = episode_frames(model, env, n_samples, deterministic=True)
    steps = np.unique(np.linspace(0, len(frames) - 1, n_panels).round().astype(int))
    return _panels(frames, steps, 3.2, 3.4)


def sequence_figure(frames: Sequence[np.ndarray], first: int, n_steps: int) -> Figure:
    """Draw consecutive steps of an episode side by side.

    Args:
        frames: Pictures of one episode.
        first: Step of the first picture, counted from 0.
        n_steps: Number of pictures.

    Raises:
        ValueError: If the episode has no such steps.
    """
    if n_steps < 1 or not 0 <= first <= len(frames) - n_steps:
        raise ValueError(
            f"first and n_steps must lie within the episode's {len(frames)} steps, "
            f"got {first} and {n_steps}"
        )
    return _panels(frames, range(first, first + n_steps), 2.4, 2.6)


def _panels(
    frames: Sequence[np.ndarray], steps: Sequence[int] | np.ndarray, width: float, height: float
) -> Figure:
    figure = new_figure(width * len(steps), height)
    for axes, step in zip(figure.subplots(1, len(steps), squeeze=False)[0], steps, strict=True):
        axes.imshow(frames[step])
        axes.set_title(f"step {step}", fontsize=9)
        axes.set_axis_off()
    return figure


def write_video(frames: Sequence[np.ndarray], path: Path, fps: float) -> None:
    """Write pictures (H, W, 3) of equal size as an MP4.

    Args:
        frames: At least one picture.
        path: File to write; must end in ``.mp4``.
        fps: Pictures per second.

    Raises:
        ValueError: If there are no pictures, or the path does not end in ``.mp4``.
        ModuleNotFoundError: If moviepy is missing.
    """
    if not frames or path.suffix != ".mp4":
        raise ValueError(f"path must end in .mp4 and frames not be empty, got {path}")
    try:
        from moviepy import ImageSequenceClip
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'videos need moviepy: pip install "sb3_flowpolicy[zoo]"'
        ) from error
    with replacing(path) as draft:
        ImageSequenceClip(list(frames), fps=fps).write_videofile(str(draft), logger=None)
