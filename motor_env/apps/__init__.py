"""Programs on top of the rooms: the paper reproduced, the laboratory page, compiling ahead."""
