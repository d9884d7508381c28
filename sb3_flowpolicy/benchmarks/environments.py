"""Steps per second of the environments, one at a time and in batches."""

from __future__ import annotations

import gymnasium as gym

import flowpolicy_envs
from sb3_flowpolicy.benchmarks.timing import Contest, Entrant, Work

# One per family of what a step computes. To add one, add its id.
ENVIRONMENTS = ("TunnelDiagonal-v0", "TunnelCircle-v0", "TunnelSpline-v0", "SquareHold-v0")
# A familiar environment of about the same complexity, to judge the numbers by.
PEER = "Pendulum-v1"
BATCH = 64
# Calls of step() per piece of work: enough to hide the clock.
N_CALLS = 200


def contests(quick: bool = False) -> list[Contest]:
    """Each environment alone and as a batch, the peer likewise; ``quick`` takes the first."""
    flowpolicy_envs.register_envs()
    entrants = [
        Entrant(PEER, lambda: single(PEER)),
        Entrant(f"{PEER}, batch of {BATCH}", lambda: batch(PEER, "sync")),
    ]
    for env_id in ENVIRONMENTS[:1] if quick else ENVIRONMENTS:

        def one(env_id: str = env_id) -> Work:
            return single(env_id)

        def many(env_id: str = env_id) -> Work:
            return batch(env_id, "vector_entry_point")

        entrants += [Entrant(env_id, one), Entrant(f"{env_id}, batch of {BATCH}", many)]
    return [Contest("random actions", "steps", entrants)]


def single(env_id: str) -> Work:
    """Return steps of one environment, reset whenever an episode ends."""
    env = gym.make(env_id, disable_env_checker=True)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(N_CALLS)]
    env.reset(seed=0)

    def work() -> float:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return N_CALLS

    return work


def batch(env_id: str, vectorization_mode: str) -> Work:
    """Return steps of a batch of environments, which resets itself; counts each one's steps."""
    env = gym.make_vec(env_id, num_envs=BATCH, vectorization_mode=vectorization_mode)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(N_CALLS)]
    env.reset(seed=0)

    def work() -> float:
        for action in actions:
            env.step(action)
        return N_CALLS * BATCH

    return work
