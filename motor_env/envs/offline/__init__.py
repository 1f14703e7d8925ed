"""Data for learning without an environment: what known policies do in it, as Minari keeps it."""
