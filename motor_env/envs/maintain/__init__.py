"""`motor_env/Maintain-v0`: a bearing that wears from start to start, and when to replace it."""
