"""Learning the parameters of scenes: where things stand and how they look."""
