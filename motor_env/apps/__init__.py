"""Programs on top of the library: the paper reproduced, the laboratory page."""
