"""Which cores a bench runs on."""

import os
from contextlib import suppress


def pin(cores: set[int]) -> None:
    """Let every thread of this process run on these cores only."""
    for thread in os.listdir("/proc/self/task"):
        # It may have ended meanwhile.
        with suppress(ProcessLookupError):
            os.sched_setaffinity(int(thread), cores)
