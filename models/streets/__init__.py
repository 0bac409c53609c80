"""Streets in 3D: their grammars, parameters and where things stand."""
