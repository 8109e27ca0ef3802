"""Open files within bounds on size and content, and write them atomically; one module for each format."""
