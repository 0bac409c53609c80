"""The Python API behind ``import probscene``; the command line calls the same."""
