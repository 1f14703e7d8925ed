"""A motor at work: its baseline from healthy windows, the verdict on each window, and the sequential monitor."""
