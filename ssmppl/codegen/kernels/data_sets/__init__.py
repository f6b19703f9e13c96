"""Passes over many data sets in one compiled call."""
