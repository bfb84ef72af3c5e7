"""One module a format: each takes an open, seekable binary file and returns a `Parsed` mesh or raises."""
