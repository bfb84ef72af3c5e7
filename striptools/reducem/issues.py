"""Every flaw of a scene file, by a code that users can cite; formats/reducem/ISSUES.md lists the same."""

from dataclasses import dataclass

from striptools.errors import UnreadableSceneError

__all__ = ["ISSUES", "Finding", "Issue", "unreadable"]

_DAMAGED = "get the file again, or convert the model again"
_WRITER = "report it to the maker of the program that wrote the file"


@dataclass(frozen=True)
class Issue:
    """A flaw: `severity` is `error` or `information`, `clause` the section of SPEC.md that rules it out."""

    code: str
    severity: str
    clause: str
    message: str
    remedy: str


@dataclass(frozen=True)
class Finding:
    """An issue found in a file, and where."""

    issue: Issue
    where: str

    def __str__(self) -> str:
        """Give one line for the user."""
        place = f"{self.where}: " if self.where else ""
        return f"{place}{self.issue.code} {self.issue.message} ({self.issue.remedy})"


_ALL = (
    Issue("RDM001", "error", "2", "the file cannot be read", "check the path and its permissions"),
    Issue("RDM101", "error", "3.1", "the file ends inside its header", _DAMAGED),
    Issue(
        "RDM102", "error", "3.1", "this is no ReduceM scene file", "give a .rdm file that striptools wrote"
    ),
    Issue(
        "RDM103", "error", "5", "the format version is not read here", "convert the model again, or update"
    ),
    Issue("RDM104", "error", "3.1", "the file is not as long as its header says", _DAMAGED),
    Issue(
        "RDM105", "error", "3.1", "the number of sections is not 1 to 64, or the table does not fit", _DAMAGED
    ),
    Issue("RDM106", "error", "3.1", "the checksum of header and section table does not fit", _DAMAGED),
    Issue("RDM107", "error", "3.2", "a reserved field or flag is not zero", _WRITER),
    Issue("RDM108", "error", "3.3", "padding is not zero", _DAMAGED),
    Issue("RDM109", "error", "3.3", "a section is empty or out of its place", _WRITER),
    Issue("RDM110", "error", "3.2", "the checksum of a section does not fit", _DAMAGED),
    Issue("RDM111", "error", "3.2", "an unknown section must be understood", "update striptools"),
    Issue("RDM112", "error", "3.2", "a kind of section is there twice", _WRITER),
    Issue("RDM113", "error", "4", "a section is missing", _WRITER),
    Issue("RDM114", "error", "4", "a section is not as long as the counts say", _WRITER),
    Issue("RDM115", "information", "3.2", "an unknown section is passed over", "update striptools"),
    Issue("RDM116", "error", "4", "a section's must-understand flag is not the one of its kind", _WRITER),
    Issue("RDM201", "error", "4.1", "a count is out of its range", _WRITER),
    Issue("RDM202", "error", "4.1", "the error bound is negative or not finite", _WRITER),
    Issue("RDM301", "error", "4.2", "a position is not finite", _WRITER),
    Issue("RDM302", "error", "4.5", "strip starts do not rise from 0 to the number of triangles", _WRITER),
    Issue("RDM303", "error", "4.4", "the first triangle of a strip has a turn", _WRITER),
    Issue("RDM304", "error", "4.4", "a turn bit past the last triangle is set", _WRITER),
    Issue("RDM305", "error", "4.3", "a strip vertex names no position", _WRITER),
    Issue("RDM306", "error", "4.3", "positions are not in the order of their first use", _WRITER),
    Issue("RDM307", "error", "4.3", "a position is used by no strip", _WRITER),
    Issue("RDM308", "error", "4.3", "a triangle names one position twice", _WRITER),
    Issue("RDM309", "error", "4.8", "a flip bit past the last triangle is set", _WRITER),
    Issue("RDM310", "error", "4.8", "the first triangle of a strip is flipped", _WRITER),
    Issue("RDM311", "error", "4.8", "there are flip bits, but none is set", _WRITER),
    Issue("RDM401", "error", "4.6", "a node of the hierarchy has an empty child", _WRITER),
    Issue("RDM402", "error", "4.6", "a box of the hierarchy is not finite", _WRITER),
    Issue("RDM403", "error", "4.6", "a box of the hierarchy does not hold what is below it", _WRITER),
    Issue("RDM501", "error", "4.7", "a rotation is not 0, 1 or 2", _WRITER),
    Issue("RDM502", "error", "4.7", "a triangle comes from a face that the source does not have", _WRITER),
    Issue("RDM503", "error", "4.7", "two triangles come from one source face", _WRITER),
)

ISSUES = {issue.code: issue for issue in _ALL}
"""Every issue by its code."""


def unreadable(code: str, where: str) -> UnreadableSceneError:
    """Make the error that refuses a scene for one issue."""
    issue = ISSUES[code]
    return UnreadableSceneError(f"{code} {issue.message}", where=where, remedy=issue.remedy)
