"""Strips: the Strip-RT ordering, and the topology of generalised and classic strips."""
