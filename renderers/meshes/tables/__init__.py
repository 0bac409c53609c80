"""The tables that the host fills and the mesh kernels read."""
