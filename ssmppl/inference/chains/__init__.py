"""Markov chain methods; each has `prepare(setup, method)`."""
