"""Recordings in text files: cells, the block of numbers, the settings of the instrument."""
