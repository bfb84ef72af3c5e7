"""All Numba code: arrays in, arrays out, no Python objects."""
