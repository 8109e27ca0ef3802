"""The folder of a run: its stages and files, the lock, the one resumable stage."""
