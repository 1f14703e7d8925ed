"""One start of a motor: its fit, and what its commutation ripple and its size tell."""
