"""The doors: how files are opened, with bounds on what they may ask for, and how they are written."""
