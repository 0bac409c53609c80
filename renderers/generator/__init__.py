"""Programs in processes of their own that draw the scenes of a model."""
