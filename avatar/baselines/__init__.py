"""Other kinds of avatars in the same harness: our rasteriser, data and losses, so that a table compares ideas alone."""
