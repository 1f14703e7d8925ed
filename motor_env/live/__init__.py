"""A motor watched while it works: where its lines come from, what is said of them."""
