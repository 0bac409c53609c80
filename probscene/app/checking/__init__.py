"""What running a model shows: faults, what can be seen, and whether its generator can be relied on."""
