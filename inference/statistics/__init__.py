"""Distances between samples, their intervals, and the verdict."""
