"""How often a policy succeeds, and what it does along one episode."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_flowpolicy.diagnostics.figures import new_figure
from sb3_flowpolicy.diagnostics.film import episode_frames

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def evaluate_success(
    model: BaseAlgorithm, env: VecEnv, n_episodes: int = 100, deterministic: bool = True
) -> tuple[float, float]:
    """Run episodes and count those that end with ``info["is_success"]``.

    Args:
        model: Any SB3 model.
        env: Vectorised environment whose infos carry ``is_success``.
        n_episodes: Number of episodes, at least 1.
        deterministic: Whether to act without exploration.

    Returns:
        Success rate in [0, 1] and mean return.

    Raises:
        ValueError: If the environment does not say whether an episode succeeded.
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


def rollout_figure(
    model: BaseAlgorithm, env: VecEnv, n_panels: int = 4, n_samples: int = 300
) -> Figure:
    """Draw the policy's action samples at several states of one deterministic episode.

    As in thesis Fig. 3.2 and 3.4. The environment draws itself; it needs the render mode
    ``rgb_array`` and a method ``set_action_samples``, as those of ``flowpolicy_envs`` have.

    Args:
        model: Any SB3 model.
        env: One environment, vectorised.
        n_panels: Number of states to show, spread evenly over the episode.
        n_samples: Number of action samples to draw at each.

    Returns:
        A matplotlib figure.

    Raises:
        ValueError: If there is more than one environment, or it cannot show action samples.
    """
    frames = episode_frames(model, env, n_samples, deterministic=True)
    chosen = np.unique(np.linspace(0, len(frames) - 1, n_panels).round().astype(int))
    figure = new_figure(3.2 * len(chosen), 3.4)
    for axes, step in zip(figure.subplots(1, len(chosen), squeeze=False)[0], chosen, strict=True):
        axes.imshow(frames[step])
        axes.set_title(f"step {step}", fontsize=9)
        axes.set_axis_off()
    return figure
