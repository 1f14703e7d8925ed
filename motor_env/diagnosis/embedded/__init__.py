"""Write a filter, a decision rule and its threshold for one motor as C99 for the motor's own controller.

`twin` computes the same bits as the C does. Begin at `source.write_library`.
"""
