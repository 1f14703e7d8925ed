"""A bearing that wears day by day. Begin with `maintain_env`; `kernel` is a day, `replacement` its policies."""
