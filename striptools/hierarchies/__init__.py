"""Hierarchies over strips and triangles: built, expanded, collapsed and checked."""
