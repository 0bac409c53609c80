"""Meta-Sim's way of learning parameters, a baseline."""
