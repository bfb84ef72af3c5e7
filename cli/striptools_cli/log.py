"""Warnings and log lines of striptools and of the libraries under it: one line each, on standard error."""

import logging
import sys
import warnings


def set_up(*, quiet: bool = False, verbose: bool = False) -> None:
    """Send log lines and warnings to standard error, one line each; only errors when quiet."""
    level = logging.ERROR if quiet else logging.INFO if verbose else logging.WARNING
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_OneLine())
    logging.getLogger().handlers[:] = [handler]
    logging.getLogger().setLevel(logging.WARNING if level == logging.INFO else level)
    logging.getLogger("striptools").setLevel(level)
    logging.captureWarnings(True)
    warnings.simplefilter("ignore" if quiet else "default")


class _OneLine(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        message = record.getMessage()
        if record.name == "py.warnings":
            # "path:line: Category: text" and the source line below it: keep the text.
            message = message.splitlines()[0].split(": ", 2)[-1]
        return f"striptools: {record.levelname.lower()}: {' '.join(message.split())}"
