"""The SAC update as a pure function of tensors: eager, compiled, or stacked over seeds."""

from sb3_flowpolicy.engine.engine import Engine, update_settings, why_unsupported

__all__ = ["Engine", "update_settings", "why_unsupported"]
