"""Distances between samples, their tests and intervals, and the verdict."""
