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

    Returns:
        Success rate in [0, 1] and mean return.

    Raises:
        KeyError: If the environment does not report ``is_success``.
    """
    outcomes: list[bool] = []

    def note_outcome(local_vars: dict[str, Any], _: dict[str, Any]) -> None:
        if local_vars["done"]:
            outcomes.append(bool(local_vars["info"]["is_success"]))

    mean_return, _ = evaluate_policy(
        model, env, n_episodes, deterministic=deterministic, callback=note_outcome
    )
    return float(np.mean(outcomes)), float(np.mean(mean_return))


def episode_frames(
    model: BaseAlgorithm, env: VecEnv, n_samples: int = 300, deterministic: bool = False
) -> list[np.ndarray]:
    """Play one episode and render it with samples of the policy's actions.

    ``env`` is one vectorized environment with the render mode ``rgb_array`` and a method
    ``set_action_samples``, as in ``flowpolicy_envs``. ``deterministic`` applies to the actions
    that are taken; the samples always include exploration.

    Returns:
        One picture (size, size, 3) per step, rendered before its action.
    """
    frames = []
    obs, done = env.reset(), False
    while not done:
        assert isinstance(obs, np.ndarray)
        samples, _ = model.predict(np.repeat(obs, n_samples, axis=0))
        env.env_method("set_action_samples", samples)
        frame = env.render(mode="rgb_array")
        assert frame is not None
        frames.append(frame)
        action, _ = model.predict(obs, deterministic=deterministic)
        obs, _, (done,), _ = env.step(action)
    return frames


def rollout_figure(
    model: BaseAlgorithm, env: VecEnv, n_panels: int = 4, n_samples: int = 300
) -> Figure:
    """Draw :func:`episode_frames` at steps spread evenly over a deterministic episode."""
    frames = episode_frames(model, env, n_samples, deterministic=True)
    steps = np.unique(np.linspace(0, len(frames) - 1, n_panels).round().astype(int))
    return _panels(frames, steps, 3.2, 3.4)


def sequence_figure(frames: Sequence[np.ndarray], first: int, n_steps: int) -> Figure:
    """Draw up to ``n_steps`` steps of an episode side by side, from step ``first``, counted from 0.

    Raises:
        ValueError: If the episode has no such step.
    """
    if first >= len(frames):
        raise ValueError(f"first step must be below {len(frames)}, the frames, got {first}")
    return _panels(frames, range(len(frames))[first : first + n_steps], 2.4, 2.6)


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
    """Write pictures (H, W, 3) of equal size as a video, such as an MP4. Needs moviepy."""
    from moviepy import ImageSequenceClip

    with replacing(path) as draft:
        ImageSequenceClip(list(frames), fps=fps).write_videofile(str(draft), logger=None)
