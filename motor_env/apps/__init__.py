"""Programs on top of both wings: the paper reproduced, the laboratory page, compiling ahead.

They hold no equation and no decision. Begin at `reproduce` or `lab`.
"""
