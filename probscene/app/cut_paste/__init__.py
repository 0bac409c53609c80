"""A first model of a few labelled photographs: what they show is cut out, and pasted on what is left of them."""
