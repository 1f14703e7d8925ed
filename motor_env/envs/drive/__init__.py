"""A drive that fails while it works: follow a speed, see the fault, and limp or stop in time."""
