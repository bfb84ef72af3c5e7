"""Kernels for GPUs, in Pallas. Each has a twin in plain JAX, which runs everywhere and gives the same hits."""
