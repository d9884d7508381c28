"""Pictures of trained agents on the Square (thesis Fig. 3.17 and 3.19)."""
