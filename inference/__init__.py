"""What is learned or measured. Import the leaf modules."""
