"""A synthetic capture of the fixture person: her performance, cloth in motion, soft light, cameras, files."""
