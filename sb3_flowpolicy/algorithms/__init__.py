"""The algorithms: SACFlow, TQCFlow, CrossQFlow, PPOFlow, and what they explore with."""
