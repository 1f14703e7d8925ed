"""Files of trained models, without pickle. Begin at `persistence`."""
