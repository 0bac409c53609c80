"""Labelled images, their formats and provenance."""
