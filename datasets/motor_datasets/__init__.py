"""Labelled transients of brushed DC motors: generated, stored, loaded."""
