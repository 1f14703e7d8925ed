"""Judge a motor at work window by window: its healthy baseline, the verdict on a log, and the sequential monitor.

It never reads a file; windows are fitted in `estimation`. Begin at `windows.WindowJudge`.
"""
