"""What a verdict on a fit is made of: images of each source, three aspects, and what to do."""
