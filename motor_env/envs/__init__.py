"""Gymnasium environments: a motor that may be failing."""
