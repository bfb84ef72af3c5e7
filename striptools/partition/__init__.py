"""Partition: the one cost model and the SAH object split down to single items."""
