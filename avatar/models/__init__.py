"""The networks of the teacher and the student: modules alone, without losses or training."""
