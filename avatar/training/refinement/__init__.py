"""Poses refined on photographs of training cameras, through the rasteriser."""
