"""motor-bench: frozen tasks, submissions to them, their scores and ranks."""
