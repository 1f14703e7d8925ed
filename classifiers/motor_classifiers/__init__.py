"""Classifiers of motor faults, and the benchmark that compares them."""
