"""Maker of the network that reads lips from sound: its material and its training."""
