"""Write a filter, a decision rule and its threshold for one motor as C99 for the motor's own controller.

`twin` computes to the bit as the C does. Nothing here learns or reads recordings. Begin at `source.write_library`.
"""
