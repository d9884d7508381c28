"""Several seeds trained in lockstep: SeedBatch and its command."""
