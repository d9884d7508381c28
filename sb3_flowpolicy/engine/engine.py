"""The engine: binds models to flat tensors, updates them, and releases them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_flowpolicy.engine.adam import FlatAdam, adam_settings
from sb3_flowpolicy.engine.compiling import Compiled, Compiler
from sb3_flowpolicy.engine.flat import FlatParameters
from sb3_flowpolicy.engine.groups import seeds_at_once
from sb3_flowpolicy.engine.replay import ReplayRows, draw_index, is_plain, sample_columns
from sb3_flowpolicy.engine.runtime import BoundEngine, Place, why_network_unsupported
from sb3_flowpolicy.engine.update import LOSSES, Batch, TrainState, UpdateSettings
from sb3_flowpolicy.policies import FlowActor


class Engine(BoundEngine):
    """Updates S models of SAC, TQC or CrossQ in lockstep.

    Their method ``objective()`` returns how they use their critics.
    """

    def __init__(self, models: Sequence[Any], compiled: bool = False) -> None:
        super().__init__(models, compiled)
        first = self.models[0]
        self.objective = first.objective()
        policies = [model.policy for model in self.models]
        self.networks = self.objective.networks_type(policies, first.autocast)
        self.actor_adam = FlatAdam(
            self.networks.actor, [policy.actor.optimizer for policy in policies]
        )
        self.critic_adam = FlatAdam(
            self.networks.critic, [policy.critic.optimizer for policy in policies]
        )
        networks, device = self.networks, self.networks.actor.data.device
        self.acting_parts = networks.acting
        self.parts = [networks.actor, networks.critic, *networks.others]
        self.parts += [self.actor_adam, self.critic_adam]
        self.log_ent_coef: FlatParameters | None = None
        self.ent_coef_adam: FlatAdam | None = None
        if first.ent_coef_optimizer is not None:
            # An optimizer owns it, although it belongs to no module.
            self.log_ent_coef = FlatParameters(
                [{"log_ent_coef": [model.log_ent_coef]} for model in self.models]
            )
            optimizers = [model.ent_coef_optimizer for model in self.models]
            self.ent_coef_adam = FlatAdam(self.log_ent_coef, optimizers)
            self.parts += [self.log_ent_coef, self.ent_coef_adam]
        self._note([place for model in self.models for place in _places(model)])

        def sample(actor: th.Tensor, obs: th.Tensor, noise: th.Tensor) -> th.Tensor:
            return networks.sample(actor, obs, noise)[0]

        self.compiler = Compiler(device, enabled=compiled)
        update = self.objective.make_update(networks, self.settings)
        self._update = Compiled(update, f"the {self.objective.name} update", self.compiler)
        self._sample = Compiled(sample, "the policy", self.compiler)
        #: Losses of each update of the last :meth:`train`, (4, S): to find out which went wrong.
        self.history: list[th.Tensor] = []
        #: Names of the losses to log of the last :meth:`train`.
        self.logged: tuple[str, ...] = LOSSES
        self._rows: ReplayRows | None = None
        # Making these anew takes a sixth of the time of a small network's update.
        self._grouped: tuple[int, list[tuple[slice, TrainState]]] | None = None
        self._fixed: list[tuple[th.Tensor, int]] = []
        self._learning_rates: tuple[list[float], th.Tensor] | None = None

    @staticmethod
    def why_unsupported(model: Any) -> str | None:
        """Return which part of a model the engine does not support, or None."""
        policy, objective = model.policy, model.objective()
        if objective is None:
            return f"the update of {type(model).__name__}"
        has_gsde = type(policy.actor) is objective.gsde_actor_type and policy.actor.use_sde
        if not (has_gsde or isinstance(policy.actor, FlowActor)):
            with_gsde = " with gSDE" if model.use_sde else ""
            return f"actor of type {type(policy.actor).__name__}{with_gsde}"
        if model.use_sde != policy.actor.use_sde:
            return f"use_sde={model.use_sde} with an actor made with use_sde={not model.use_sde}"
        if type(policy.critic) is not objective.critic_type:
            return f"critic of type {type(policy.critic).__name__}"
        space = model.observation_space
        parts = space.values() if isinstance(space, spaces.Dict) else [space]
        if not all(part.shape for part in parts):
            return f"observation space {space}"
        if _has_tensors(policy.critic.features_extractor):
            return "features extractor with parameters or buffers"
        for network in policy.critic.q_networks:
            for layer in network.children():
                if not isinstance(layer, objective.layer_types) and _has_tensors(layer):
                    return f"critic layer of type {type(layer).__name__}, which has parameters"
        for network in (policy.actor, policy.critic):
            reason = why_network_unsupported(network)
            if reason is not None:
                return reason
        return objective.why_unsupported(policy)

    @staticmethod
    def settings_of(model: Any) -> UpdateSettings:
        """Return the constants of a model's update."""
        optimizers = (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer)
        objective = model.objective()
        return UpdateSettings(
            objective,
            objective.layer_constants(model.policy),
            model.autocast,
            model.tau,
            float(model.target_entropy),
            *map(adam_settings, optimizers),  # type: ignore[arg-type]
        )

    @th.no_grad()
    def act(self, obs: th.Tensor, noise: th.Tensor | None = None) -> th.Tensor:
        """Sample scaled actions in [-1, 1], (S, N, D), for observations (S, N, ...).

        The noise consists of standard normals, (S, N, M), by default drawn here.
        """
        actor = self.networks.actor.data
        if noise is None:
            shape = (*obs.shape[:2], self.networks.noise_dim)
            noise = th.randn(shape, dtype=actor.dtype, device=actor.device)
        return self._sample((obs.shape, obs.dtype), actor, obs, noise)

    def act_if_compiled(self, obs: Any, deterministic: bool) -> np.ndarray | None:
        """Act for one seed if there is a graph for so many observations, as tensors (N, ...).

        Returns:
            Scaled actions, (N, D), or None.
        """
        rows = self.networks.observations.pack(obs).unsqueeze(0).contiguous()
        if (rows.shape, rows.dtype) not in self._sample:
            return None
        noise = None
        if deterministic:  # the mode is the image of no noise
            shape = (*rows.shape[:2], self.networks.noise_dim)
            noise = self.networks.actor.data.new_zeros(shape)
        return self.act(rows, noise).squeeze(0).cpu().numpy()

    def synchronize(self) -> bool:
        """Take over what was loaded or moved since the last update; return whether anything was."""
        # A fixed entropy coefficient may be replaced between two calls, or changed in place.
        fixed = [(tensor, tensor._version) for tensor in self._fixed_ent_coefs()]
        if len(fixed) != len(self._fixed) or any(
            now is not then or version != before
            for (now, version), (then, before) in zip(fixed, self._fixed, strict=True)
        ):
            self._grouped, self._fixed = None, fixed
        changed = super().synchronize()
        if changed:
            self._grouped = None
        return changed

    def _fixed_ent_coefs(self) -> list[th.Tensor]:
        return [] if self.log_ent_coef else [model.ent_coef_tensor for model in self.models]

    def state(self) -> TrainState:
        """Return what an update of all seeds changes."""
        if self.log_ent_coef is not None:
            ent_coef = self.log_ent_coef.data
        else:
            ent_coef = th.stack([tensor.reshape(1) for tensor in self._fixed_ent_coefs()])
        return TrainState(
            self.networks.actor.data,
            self.networks.critic.data,
            tuple(part.data for part in self.networks.others),
            ent_coef,
            self.actor_adam.moments,
            self.critic_adam.moments,
            None if self.ent_coef_adam is None else self.ent_coef_adam.moments,
        )

    def _groups(self, batch_size: int) -> list[tuple[slice, TrainState]]:
        """Return the seeds that are updated together, and what an update of them changes."""
        if self._grouped is None or self._grouped[0] != batch_size:
            state, count = self.state(), len(self.models)
            size = seeds_at_once(self.models[0].critic, count, batch_size)
            slices = [slice(start, start + size) for start in range(0, count, size)]
            groups = [(seeds, state if size == count else state.of(seeds)) for seeds in slices]
            self._grouped = batch_size, groups
        return self._grouped[1]

    def draw(self, n_updates: int, batch_size: int) -> list[Batch]:
        """Draw minibatches and noise for ``n_updates`` updates at once."""
        buffers = [model.replay_buffer for model in self.models]
        if all(map(_can_be_rows, self.models)):
            if self._rows is None or not self._rows.holds(buffers):
                self._rows = ReplayRows(buffers)
            index = draw_index(buffers, n_updates, batch_size)
            noise = self.networks.draw_noise(n_updates, batch_size)
            return self._rows.take(index, self.models[0].gamma, noise)
        columns = [
            sample_columns(model, self.networks.observations, n_updates, batch_size)
            for model in self.models
        ]
        stacked = [th.cat(parts, dim=1) for parts in zip(*columns, strict=True)]
        noise = self.networks.draw_noise(n_updates, batch_size)
        return [Batch(*(part[k] for part in (*stacked, noise))) for k in range(n_updates)]

    def train(self, batches: Sequence[Batch], start: int = 0) -> th.Tensor:
        """Perform one update of all models per batch.

        Args:
            batches: As :meth:`draw` returns them, at least one.
            start: Number of updates done already in the same call of the model's ``train``.

        Returns:
            Losses, means over the updates, (4, S); see ``LOSSES``.
        """
        first = self.models[0]
        # A fixed entropy coefficient takes no steps.
        third = first.ent_coef_optimizer or first.actor.optimizer
        optimizers = (first.actor.optimizer, first.critic.optimizer, third)
        rates = [optimizer.param_groups[0]["lr"] for optimizer in optimizers]
        if self._learning_rates is None or self._learning_rates[0] != rates:
            device = self.networks.actor.data.device
            self._learning_rates = rates, th.tensor(rates, dtype=th.float64, device=device)
        learning_rates = self._learning_rates[1]
        groups = self._groups(batches[0].rewards.shape[1])
        history = self.history = []
        flags = [self.objective.is_due(first, k, start) for k in range(len(batches))]
        for batch, flag in zip(batches, flags, strict=True):
            losses = []
            for seeds, state in groups:
                part = batch if len(groups) == 1 else batch.of(seeds)
                losses.append(self._update_once(state, part, learning_rates, flag))
            history.append(losses[0] if len(losses) == 1 else th.cat(losses, dim=1))
        means, self.logged = self.objective.mean_losses(history, sum(flags))
        return means

    def _update_once(
        self, state: TrainState, batch: Batch, learning_rates: th.Tensor, flag: bool
    ) -> th.Tensor:
        key = (batch.noise.shape, batch.noise.stride(), batch.obs.stride(), flag)
        return self._update(key, state, batch, learning_rates, flag)


def _can_be_rows(model: Any) -> bool:
    """Whether minibatches can be rows of floats; pixels would take four times the memory."""
    buffer = model.replay_buffer
    fits = is_plain(buffer) and model.get_vec_normalize_env() is None
    return fits and buffer.observations.dtype.kind == "f"


def _places(model: Any) -> list[Place]:
    """Return where the objects are whose tensors an engine binds.

    Of each network's parameters the first is enough: they are replaced, frozen, or moved all at
    once, by ``load_state_dict(assign=True)`` or ``actor.requires_grad_(False)`` for example. Of the
    layers' buffers, which ``policy.to(dtype)`` replaces, all are returned.
    """
    places: list[Place] = [
        (vars(model), "policy"),
        (vars(model.actor), "optimizer"),
        (vars(model.critic), "optimizer"),
        (vars(model), "ent_coef_optimizer"),
        (vars(model), "log_ent_coef"),
    ]
    layer_types = model.objective().layer_types
    targets = [model.critic_target] if hasattr(model, "critic_target") else []
    for network in (model.actor, model.critic, *targets):
        path, _ = next(network.named_parameters())
        module, _, name = path.rpartition(".")
        places.append((network.get_submodule(module)._parameters, name))
        for layer in network.modules():
            if isinstance(layer, layer_types):
                places += [(layer._buffers, key) for key in layer._buffers]
    return places


def _has_tensors(module: th.nn.Module) -> bool:
    return bool([*module.parameters(), *module.buffers()])
