"""The motor: parameters, equations, faults, and the file that holds its data sheet."""
