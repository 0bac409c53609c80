"""What a camera makes of an image."""
