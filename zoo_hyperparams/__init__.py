"""Hyperparameter files for rl_zoo3, one per algorithm."""
