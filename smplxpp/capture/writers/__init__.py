"""Write the files of a capture: description, cameras, images, arrays."""
