"""Kernels for GPUs, in Pallas. Each has a twin in plain JAX that runs everywhere, with the same hits."""
