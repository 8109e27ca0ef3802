"""Read the layouts of data sets, one module for each, into a Recording."""
