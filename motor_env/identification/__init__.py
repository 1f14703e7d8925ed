"""A real motor's parameters, fitted to recorded starts and coast-downs."""
