"""What a validation knows of a file so far, and what it found: the state that its parts share."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from striptools.reducem.issues import ISSUES, Finding

__all__ = ["Inspection", "Section"]


@dataclass(frozen=True)
class Section:
    """A section: its kind, the byte of the file where it begins, its codec and its decoded bytes."""

    kind: str
    offset: int
    codec: int
    data: bytes

    def at(self, byte: int) -> int:
        """The byte of the file where a byte of the section is; the section's first one where it is packed."""
        return self.offset + (0 if self.codec else int(byte))


@dataclass
class Inspection:
    """A file under inspection.

    Attributes:
        data: The bytes of the file.
        where: What findings call it.
        findings: What was found.
        sections: The sections that could be decoded, by kind.
        undecoded: The kinds of sections that are there but could not be decoded.
    """

    data: bytes
    where: str
    findings: list[Finding] = field(default_factory=list)
    sections: dict[str, Section] = field(default_factory=dict)
    undecoded: set[str] = field(default_factory=set)

    def found(self, code: str, place: str = "", offset: int | None = None) -> None:
        """Note an issue at a byte of the file."""
        where = f"{self.where}: {place}" if place else self.where
        byte = None if offset is None else int(offset)
        self.findings.append(Finding(ISSUES[code], where, byte, place))

    def found_where(
        self, code: str, wrong: np.ndarray, place: Callable[[int], str], offset: Callable[[int], int]
    ) -> bool:
        """Note an issue once for all items that have it, at the first of them.

        Args:
            code: Of the issue.
            wrong: Booleans, an item each.
            place: What the finding calls an item.
            offset: The byte of the file of an item.

        Returns:
            Whether any item has it.
        """
        count = int(np.count_nonzero(wrong))
        if count:
            first = int(np.argmax(wrong))
            more = f" (the first of {count})" if count > 1 else ""
            self.found(code, place(first) + more, offset(first))
        return count > 0
