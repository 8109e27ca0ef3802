"""How good an avatar is: images, surface, speed and size, measured the same way for every model."""
