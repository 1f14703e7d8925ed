"""Failed sensors: told before any fault of a motor."""
