"""Generative models of scenes, one domain a file. Import the leaf modules."""
