"""Guides: policies that learn."""
