"""A drive that fails while it works. Begin with `drive_env`; `kernel` is its step, `lqg` its policies."""
