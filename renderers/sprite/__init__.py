"""The sprite renderer's tables and kernel."""
