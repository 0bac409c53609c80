"""Reading the values of sites in images."""
