"""The public functions: arguments checked, methods called, results labelled."""
