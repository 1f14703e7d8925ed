"""Torch networks as scikit-learn classifiers, trained by one loop. Begin at `epoch_classifier`."""
