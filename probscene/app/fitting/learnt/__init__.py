"""What a fit leaves behind: parameters, and the guide or the prior."""
