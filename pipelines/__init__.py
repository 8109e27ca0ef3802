"""The command line and what it runs: stages of a run, captures, reports."""
