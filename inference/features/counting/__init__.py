"""Networks that count the objects of an image."""
