"""A motor at work: one physical model for any record, its fit, and the judgement of windows of a running motor."""
