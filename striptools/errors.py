"""Errors that a user can act on: one line of what, where and remedy, and the exit code it ends in."""

EXIT_DONE = 0
EXIT_ISSUES = 1
EXIT_USAGE = 2
EXIT_UNREADABLE = 3


class StriptoolsError(Exception):
    """The base of every error that striptools raises on purpose; `str()` of it is one line for the user.

    Args:
        what: What is wrong.
        where: The file, option or place it is wrong in; left out of the line when empty.
        remedy: What the user can do about it; left out of the line when empty.
    """

    exit_code = EXIT_UNREADABLE

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        self.what = what
        self.where = where
        self.remedy = remedy
        line = f"{where}: {what}" if where else what
        super().__init__(" ".join(f"{line} ({remedy})".split()) if remedy else " ".join(line.split()))


class UnreadableMeshError(StriptoolsError):
    """An input that is no mesh: malformed, truncated, of an unknown format, or without a triangle."""


class UnreadableSceneError(StriptoolsError):
    """A file that is no valid scene file, or one of a version that this package does not read."""


class WriteError(StriptoolsError):
    """An output that could not be written whole; nothing half-written is left behind."""


class LimitError(StriptoolsError):
    """An input larger than a limit of the format or of an algorithm."""


class UsageError(StriptoolsError):
    """A call or command line that asks for something that cannot be done."""

    exit_code = EXIT_USAGE


class MissingExtraError(UsageError):
    """A feature that needs an optional extra which is not installed."""
