"""The surface followed through the training frames."""
