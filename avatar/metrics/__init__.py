"""What a model is measured by: images, surfaces, speed and size."""
