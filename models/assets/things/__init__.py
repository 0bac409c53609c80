"""Meshes made by code, a module a family."""
