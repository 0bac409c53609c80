"""The mesh renderer's kernels."""
