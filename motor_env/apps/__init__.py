"""Programs: the paper reproduced, the laboratory page, compiling ahead.

Begin at `reproduce` or `lab`.
"""
