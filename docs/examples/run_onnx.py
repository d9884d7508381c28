"""Run an exported policy with onnxruntime and gymnasium: neither torch nor sb3_flowpolicy.

python run_onnx.py tunnel.onnx --env TunnelDiagonal-v0 --sample
"""

import argparse

import gymnasium as gym
import numpy as np
import onnxruntime

import flowpolicy_envs  # noqa: F401, registers the environments

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("model", help="file written by: python -m sb3_flowpolicy.export onnx MODEL")
parser.add_argument("--env", default="TunnelDiagonal-v0", help="environment id")
parser.add_argument("--episodes", type=int, default=100, help="number of episodes")
parser.add_argument("--sample", action="store_true", help="explore (exported with --stochastic)")
args = parser.parse_args()

session = onnxruntime.InferenceSession(args.model, providers=["CPUExecutionProvider"])
noise_dims = [i.shape[1] for i in session.get_inputs() if i.name == "noise"]
rng = np.random.default_rng(0)
env, successes, returns = gym.make(args.env), 0, 0.0
for episode in range(args.episodes):
    obs, _ = env.reset(seed=episode)
    done = False
    while not done:
        feed = {"obs": obs[None]}  # one observation is a batch of one
        for dim in noise_dims:
            feed["noise"] = rng.standard_normal((1, dim), dtype=np.float32)
        (action,) = session.run(["sampled_action" if args.sample else "action"], feed)
        obs, reward, terminated, truncated, info = env.step(action[0])
        done, returns = terminated or truncated, returns + float(reward)
    successes += info["is_success"]
print(f"{args.env}: success {successes} of {args.episodes}, return {returns / args.episodes:.2f}")
