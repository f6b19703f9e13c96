"""Models and their traces: what a user declares, and what a call of it on symbols gives."""
