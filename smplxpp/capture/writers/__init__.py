"""Files of a capture, written: cameras, images, arrays."""
