"""One module a format for meshes that carry more than geometry; each makes the bytes of a file."""
