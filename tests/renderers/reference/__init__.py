"""The slow twins of the renderers, in plain numpy: an independent reference for the tests."""
