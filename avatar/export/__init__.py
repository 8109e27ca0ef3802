"""Files that other viewers read."""
