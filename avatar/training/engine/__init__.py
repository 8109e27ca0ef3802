"""What every training shares: the loop, tasks solved by gradients, checkpoints, processes, logs."""
