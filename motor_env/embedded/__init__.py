"""A filter, a decision rule and its threshold for one motor as C99 for the motor's own controller."""
