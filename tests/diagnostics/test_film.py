"""Videos and sequences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.diagnostics.episodes import episode_frames, sequence_figure, write_video

pytest.importorskip("matplotlib")


class Still:
    """A stand-in for a model: all actions are zero."""

    def predict(self, obs: np.ndarray, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        return np.zeros((len(obs), 8), np.float32), None


@pytest.fixture
def frames() -> list[np.ndarray]:
    kwargs = {"render_mode": "rgb_array", "render_size": 64, "warm_up": 1.0}
    env = make_vec_env("SquareHold-v0", env_kwargs=kwargs, seed=0)
    return episode_frames(Still(), env, n_samples=5)  # type: ignore[arg-type]


def test_an_episode_has_a_frame_for_each_of_its_steps(frames: list[np.ndarray]) -> None:
    # Four steps of warm-up, and the one in which the square drops.
    assert len(frames) == 5
    assert {frame.shape for frame in frames} == {(64, 64, 3)}
    assert not np.array_equal(frames[0], frames[-1])


def test_sequences_show_consecutive_steps(frames: list[np.ndarray]) -> None:
    figure = sequence_figure(frames, first=1, n_steps=3)
    assert [axes.get_title() for axes in figure.axes] == ["step 1", "step 2", "step 3"]
    for k, axes in enumerate(figure.axes):
        assert np.array_equal(axes.images[0].get_array(), frames[1 + k])  # type: ignore[arg-type]
    figure = sequence_figure(frames, first=3, n_steps=7)
    assert [axes.get_title() for axes in figure.axes] == ["step 3", "step 4"]
    with pytest.raises(ValueError, match="first step must be below 5, the frames, got 5"):
        sequence_figure(frames, first=5, n_steps=2)


def test_videos_hold_all_frames(frames: list[np.ndarray], tmp_path: Path) -> None:
    moviepy = pytest.importorskip("moviepy")
    path = tmp_path / "film.mp4"
    write_video(frames, path, fps=4)
    with moviepy.VideoFileClip(str(path)) as clip:
        assert clip.size == [64, 64]
        assert clip.duration == pytest.approx(len(frames) / 4)
    assert [file.name for file in tmp_path.iterdir()] == ["film.mp4"]
    with pytest.raises(ValueError, match="couldn't find the codec"):
        write_video(frames, tmp_path / "film.text", fps=4)
