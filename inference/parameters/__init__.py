"""Learning the parameters of scenes: position and appearance."""
