"""What several benchmarks share: the store of results, scenes and voices, the page of results."""
