"""The mesh: loading, cleaning, adjacency, saving."""
