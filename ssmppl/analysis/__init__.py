"""Analyses of a traced model: each gives a finding, or NotApplicable with the reason."""
