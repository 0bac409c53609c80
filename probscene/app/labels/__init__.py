"""Labels that people give of a target's images: counts and boxes, read and checked."""
