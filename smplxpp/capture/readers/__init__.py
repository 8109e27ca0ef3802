"""One reader a data set: each module has `NAME`, `LOOKS_FOR`, `detect(root)` and `read(root, options)`."""
