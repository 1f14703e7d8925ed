"""Detection: decision rules on residuals, the run lengths they have, and confirmation by thresholds."""
