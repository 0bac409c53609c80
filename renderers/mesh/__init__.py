"""The mesh renderer's tables and atlases."""
