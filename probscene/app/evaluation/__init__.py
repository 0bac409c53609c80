"""A run held against its target and against labels."""
