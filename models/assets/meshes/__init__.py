"""Meshes from a folder of files."""
