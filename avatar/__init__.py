"""The trainer of the compact avatar: rasteriser, Gaussians on the template, losses, networks, training, export."""
