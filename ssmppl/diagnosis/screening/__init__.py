"""Score tests of all candidates, the checks of predictions, and their family-wise p-values."""
