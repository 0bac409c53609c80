"""Features that are the counts of another detector."""
