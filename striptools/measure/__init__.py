"""The proof: a float64 oracle that shares nothing with the tracer, and what it says of a traced scene."""
