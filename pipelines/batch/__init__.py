"""Many subjects: a chain of commands for each, kept apart, on this machine, Ray or Slurm; records on the disk."""
