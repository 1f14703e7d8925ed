"""Torch networks behind scikit-learn's interface, trained by one loop. Begin at `epoch_classifier`."""
