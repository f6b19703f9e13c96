"""Models that users brought, each with the first 60 rows of its record beside it as a CSV file."""
