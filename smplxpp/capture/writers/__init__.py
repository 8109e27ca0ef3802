"""Files of a capture, written: description, cameras, images, arrays."""
