"""Training of the teacher: tracking, pretraining, then photographs."""
