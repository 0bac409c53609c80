"""From a model and images to a run."""
