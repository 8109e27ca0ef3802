"""Makers of the data that the package ships: the open body and the fixture person. They need the extra `fixture`."""
