"""Detection: decision rules on residuals, and the run lengths they have."""
