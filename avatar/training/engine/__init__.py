"""Parts that all trainings share: the loop, optimisation tasks, checkpoints, processes and logs."""
