"""What a transient tells about a motor: fits, bounds, posterior probabilities of faults and their severity."""
