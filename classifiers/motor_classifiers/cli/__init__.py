"""The command line `motor-classifiers`."""
