"""The mesh renderer's Taichi kernels."""
