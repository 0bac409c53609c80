"""Scenes to labelled pixels. Import the leaf modules."""
