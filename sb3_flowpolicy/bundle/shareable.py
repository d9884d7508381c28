"""Safe bundles as methods of a model."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flowpolicy.bundle.model import load_bundle, save_bundle
from sb3_flowpolicy.bundle.normalization import Normalization

SelfShareable = TypeVar("SelfShareable", bound="Shareable")


class Shareable(SAC):
    """Mixin for SAC, to be named before it: models that can be sent to strangers."""

    #: What a bundle that was loaded without environment says about ``VecNormalize``.
    normalization: Normalization | None = None

    def save_safe(self, path: str | Path, vec_normalize: VecNormalize | None = None) -> Path:
        """Write a safe bundle: one file that can be shared, as loading it executes nothing.

        It holds the policy, target networks, optimisers, temperature, all settings, and the
        statistics of ``VecNormalize``; not the replay buffer. ``docs/guide/sharing.md`` tells more.

        Args:
            path: File to write, ``.safetensors`` where it has no suffix.
            vec_normalize: Statistics to include. Default: those of the model's environment.

        Returns:
            The file's path.

        Raises:
            ValueError: If the model has a part that needs code, such as a features extractor of
                your own or a learning rate that is a function; the message names it.

        Example:
            >>> import tempfile
            >>> import numpy as np
            >>> from sb3_flowpolicy import SACFlow
            >>> model = SACFlow("FlowPolicy", "Pendulum-v1")
            >>> path = model.save_safe(tempfile.mkdtemp() + "/pendulum")
            >>> SACFlow.load_safe(path).predict(np.zeros(3), deterministic=True)[0].shape
            (1,)
        """
        return save_bundle(self, path, vec_normalize)

    @classmethod
    def load_safe(
        cls: type[SelfShareable],
        path: str | Path,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
    ) -> SelfShareable:
        """Read what :meth:`save_safe` wrote, without executing anything the file says.

        Args:
            path: The file.
            env: Environment to train on in, as it was before any ``VecNormalize``: if the model
                has statistics, they are wrapped around it. Default: none, to predict only;
                observations then go through ``model.normalization`` where that is not None.
            device: Where the model goes.

        Returns:
            The model.

        Raises:
            BundleError: A ``ValueError``, if anything in the file is not as it was written.
            ValueError: If ``env`` has other spaces.
        """
        return load_bundle(cls, path, env, device)
