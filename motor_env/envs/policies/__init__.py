"""Policies and bounds that scores in the environments are compared with."""
