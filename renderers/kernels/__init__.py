"""What the kernels of both renderers share: pixels side by side, and what a camera makes of them."""
