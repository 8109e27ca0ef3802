"""The teacher: pretraining and training."""
