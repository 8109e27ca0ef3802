"""The student: pretraining, bake, compensation, pruning."""
