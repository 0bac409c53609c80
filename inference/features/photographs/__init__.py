"""Counts in photographs: heads on a pretrained network's maps, and the rules by which they are read."""
