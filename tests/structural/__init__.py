"""Tests of ssmppl/structural."""
