"""How much memory there is to keep a scene in."""

import os
from pathlib import Path
from typing import Any

EXPANDED_BYTES = 90
"""What an expanded scene takes a triangle at most, about: 320 bytes a leaf, 224 a node, 12 a face, and the size
classes."""


def free_memory(device: Any) -> int:
    """Bytes that are free on a device, or on this machine where the device does not tell."""
    stats = device.memory_stats() if device.platform != "cpu" else None
    if stats and "bytes_limit" in stats:
        return int(stats["bytes_limit"]) - int(stats.get("bytes_in_use", 0))
    return _free_here()


def _free_here() -> int:
    """What Linux calls available; else half of the memory there is."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
