"""The examples against answers by other programs: `python -m examples.check`."""
