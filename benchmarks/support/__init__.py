"""Share the store of results, captures with a known truth, voices and the page of results."""
