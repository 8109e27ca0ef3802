"""The live viewer of `smplxpp label`: labels and landmarks of a run's scan, corrected by hand."""
