"""How TensorBoard's custom-scalars page opens: the questions one asks of a SAC run, in order."""

DASHBOARD: dict[str, dict[str, list]] = {
    "Does it learn?": {
        "return (training: with exploration, test: deterministic)": [
            "Multiline",
            ["rollout/ep_rew_mean", "eval/mean_reward"],
        ],
        "success rate": ["Multiline", ["rollout/success_rate", "eval/success_rate"]],
    },
    "How does it explore?": {
        "entropy (nats)": ["Multiline", ["policy/entropy"]],
        "temperature": ["Multiline", ["train/ent_coef"]],
        "spread of each action": ["Multiline", [r"policy/scale_\d+"]],
        "correlation of actions (mean of absolute values)": [
            "Multiline",
            ["policy/mean_abs_correlation"],
        ],
    },
    "Is it healthy?": {
        "Q": ["Multiline", ["value/q_policy", "value/q_buffer"]],
        "losses": ["Multiline", ["train/critic_loss", "train/actor_loss"]],
        "steps per second": ["Multiline", ["time/fps"]],
    },
}
"""Category -> chart -> [kind, tags]: what ``SummaryWriter.add_custom_scalars`` takes."""
