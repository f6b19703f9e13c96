"""The report of a diagnosis: its tables, its words, its plots, its page and the model file."""
