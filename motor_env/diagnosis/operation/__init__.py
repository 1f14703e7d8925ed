"""Judge a motor at work window by window: healthy baseline, verdict on a log, sequential monitor.

Begin at `windows.WindowJudge`.
"""
