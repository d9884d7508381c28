"""How much coordinated noise is worth on a Square, predicted without training an agent."""
