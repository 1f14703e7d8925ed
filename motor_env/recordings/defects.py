"""A recording that cannot be judged."""


class UnusableError(ValueError):
    """A recording that can be read but not judged; the message says why."""
