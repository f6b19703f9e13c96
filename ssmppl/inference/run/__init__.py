"""What every run is made of: the bound problem, tasks over executors, progress, draws."""
