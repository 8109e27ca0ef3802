"""Share the store of results, captures with a known truth and the page of results."""
