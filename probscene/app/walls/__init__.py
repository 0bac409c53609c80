"""The walls of a model: lists that end, and counts that it cannot have."""
