"""The stages of a run, from a scan to an evaluation."""
