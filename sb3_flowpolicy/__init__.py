"""Soft Actor-Critic policies that correlate and bend their action distribution."""
