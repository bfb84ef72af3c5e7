"""Every flaw of a scene file, by a code that users can cite; formats/reducem/ISSUES.md lists the same.

Codes: 0 the file, 1 the container, 2 the scene record, 5 the remap, 52 attributes, 53 materials,
54 geometries, 55 instances, 56 hierarchies of other kinds, 57 plain triangles, 6 blocks, 7 nodes, 8 runs,
9 metadata. Those of 3 and 4 belonged to formats
before 0.3 and are not used again.
"""

import sys
from dataclasses import dataclass

from striptools.errors import UnreadableSceneError

__all__ = ["ISSUES", "Finding", "Issue", "catalogue", "unreadable"]

_DAMAGED = "get the file again, or convert the model again"
_WRITER = "report it to the maker of the program that wrote the file"
_UPDATE = "update striptools"


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
    """An issue found in a file, and where.

    Attributes:
        issue: What is wrong.
        where: The file, and the place in it in words.
        offset: The byte of the file; None where none is to blame.
        place: The place in words alone.
    """

    issue: Issue
    where: str
    offset: int | None = None
    place: str = ""

    def __str__(self) -> str:
        """Give one line for the user."""
        place = f"{self.where}: " if self.where else ""
        return f"{place}{self.issue.code} {self.issue.message} ({self.issue.remedy})"


def _flaw(code: str, clause: str, message: str, remedy: str = _WRITER) -> Issue:
    return Issue(code, "error", clause, message, remedy)


def _word(code: str, clause: str, message: str, remedy: str) -> Issue:
    return Issue(code, "information", clause, message, remedy)


_ALL = (
    _flaw("RDM001", "2", "the file cannot be read", "check the path and its permissions"),
    _flaw("RDM101", "3.1", "the file ends inside its header", _DAMAGED),
    _flaw("RDM102", "3.1", "this is no ReduceM scene file", "give a .rdm file that striptools wrote"),
    _flaw("RDM103", "7", "the format version is not read here", "convert the model again, or update"),
    _flaw("RDM104", "3.1", "the file is not as long as its header says", _DAMAGED),
    _flaw("RDM105", "3.1", "the number of sections is not 1 to 64, or the table does not fit", _DAMAGED),
    _flaw("RDM106", "3.1", "the checksum of header and section table does not fit", _DAMAGED),
    _flaw("RDM107", "1", "a reserved field or bit is not zero"),
    _flaw("RDM108", "3.3", "padding is not zero", _DAMAGED),
    _flaw("RDM109", "3.3", "a section is empty or out of its place"),
    _flaw("RDM110", "3.2", "the checksum of a section's stored bytes does not fit", _DAMAGED),
    _flaw("RDM111", "3.2", "an unknown section must be understood", _UPDATE),
    _flaw("RDM112", "3.2", "a kind of section is there twice"),
    _flaw("RDM113", "4", "a section is missing"),
    _flaw("RDM114", "4", "a section is not as long as the counts say"),
    _word("RDM115", "3.2", "an unknown section is passed over", _UPDATE),
    _flaw("RDM116", "3.2", "a section's must-understand flag is not the one of its kind"),
    _flaw("RDM117", "4", "a section is there that the scene does not need"),
    _flaw("RDM118", "3.2", "a raw section has two lengths or two checksums"),
    _flaw("RDM119", "6", "the codec of a section is not known", _UPDATE),
    _flaw("RDM120", "6", "the scene record is not raw"),
    _flaw("RDM121", "6", "the stored bytes of a section do not decode to its raw length", _DAMAGED),
    _flaw("RDM122", "3.2", "the checksum of a section's decoded bytes does not fit", _DAMAGED),
    _word("RDM123", "6", "a section is passed over: its codec is not installed", "install the extra archive"),
    _flaw("RDM124", "8", "the scene is larger than this program can hold", "split the model"),
    _flaw("RDM125", "6", "the codec of a section is not one for its kind"),
    _flaw("RDM126", "6.2", "the streams of packed block data do not fit the block headers", _DAMAGED),
    _flaw("RDM201", "4.1", "a count is out of its range, or disagrees with another one"),
    _flaw("RDM202", "4.1", "the error bound is negative or not finite"),
    _flaw("RDM203", "4.1", "the grid exponent is out of its range, or there without a grid"),
    _flaw("RDM204", "4.1", "a coordinate does not lie on the grid"),
    _flaw("RDM205", "4.1", "low and high are not the bounds of the positions"),
    _flaw("RDM206", "4.1", "the exponent of a cell is out of its range"),
    _flaw("RDM207", "4.1", "the longest run is not 1 to 8, or not 0 where boxes are not stored"),
    _flaw("RDM208", "4.1", "a field of an empty scene is not zero"),
    _flaw("RDM209", "4.1", "the origin is not finite, zero, or there without its flag"),
    _flaw("RDM501", "4.6", "a rotation is not 0, 1 or 2"),
    _flaw("RDM502", "4.6", "a triangle comes from a face that the source does not have"),
    _flaw("RDM503", "4.6", "two triangles come from one source face"),
    _flaw("RDM504", "4.6", "an unused bit of the rotations is set"),
    _flaw("RDM521", "4.7", "an attribute has a name, domain or type that it cannot have, or is there twice"),
    _flaw("RDM522", "4.7", "the attributes are longer or shorter than their records say"),
    _flaw("RDM523", "4.7", "an attribute has no row, too many rows, or another index width than they need"),
    _flaw("RDM524", "4.7", "an index names no row of its attribute"),
    _flaw("RDM525", "4.7", "the rows of an attribute are not used, or not in the order of their first use"),
    _flaw("RDM526", "4.7", "two rows of an attribute are equal"),
    _flaw("RDM527", "4.7", "an unused bit of the attributes is set"),
    _flaw("RDM528", "4.7", "a group has no material"),
    _flaw("RDM531", "4.8", "the materials are no JSON array of materials in UTF-8"),
    _flaw("RDM532", "4.8", "the materials are longer than 2^22 bytes"),
    _flaw(
        "RDM541", "4.10", "the blocks or top nodes of a geometry are none, too many, or out of their order"
    ),
    _flaw("RDM542", "4.10", "the source faces of a geometry are too few, out of their order, or not there"),
    _flaw("RDM543", "4.10", "a triangle comes from a face of another geometry"),
    _flaw("RDM551", "4.11", "an instance has no geometry, or a geometry no instance"),
    _flaw("RDM552", "4.11", "a matrix is not finite, or its determinant is zero"),
    _flaw("RDM553", "4.11", "an instance reaches too far for float32"),
    _flaw("RDM554", "4.11", "the faces of an instance are out of their order, or too many"),
    _flaw("RDM561", "4.12", "the hierarchy is of no kind that is known, or over what it cannot be over"),
    _flaw("RDM562", "4.12", "the nodes or items of the hierarchy are not as many as there must be"),
    _flaw("RDM563", "4.12", "a node of the hierarchy is not sound by itself"),
    _flaw("RDM564", "4.12", "a node of the hierarchy is not where its parent has it, or has none"),
    _flaw("RDM565", "4.12", "the hierarchy is more than 128 nodes deep"),
    _flaw(
        "RDM566",
        "4.12",
        "a place, reference or tree is not in exactly one leaf of the hierarchy, or not in turn",
    ),
    _flaw("RDM567", "4.12", "the items of the hierarchy do not name what they must, or not in their order"),
    _flaw("RDM568", "4.12", "a box, cell or pair of triangles does not hold what is below it"),
    _flaw("RDM571", "4.13", "a triangle names no vertex that is there"),
    _flaw("RDM572", "4.13", "the vertices of plain triangles are not in the order of their first use"),
    _flaw("RDM573", "4.13", "a vertex of plain triangles is not used"),
    _flaw("RDM574", "4.13", "a plain triangle names one vertex twice"),
    _flaw("RDM575", "4.13", "a coordinate of plain triangles is not a finite number"),
    _flaw("RDM601", "4.2", "a block does not begin at the triangle where the one before it ends"),
    _flaw("RDM602", "4.2", "the data of a block do not begin where those before them end"),
    _flaw("RDM603", "4.2", "a block has fewer than 3 vertices, or more strips than triangles"),
    _flaw("RDM604", "4.2", "the width, mode or exponent of an axis is out of its range"),
    _flaw("RDM605", "4.2", "an unused bit of the block data is set"),
    _flaw("RDM606", "4.2", "the block data are longer or shorter than the blocks say"),
    _flaw("RDM607", "4.3", "the start bits do not begin with a strip, or are not as many as the strips"),
    _flaw("RDM608", "4.3", "the first triangle of a strip has a turn or a flip"),
    _flaw("RDM609", "4.3", "flip bits are there, but none is set"),
    _flaw("RDM610", "4.3", "more than 30 turn bits in a row are equal"),
    _flaw("RDM611", "4.3", "an index names no vertex of its block"),
    _flaw("RDM612", "4.3", "the indices are not in the order of their first use"),
    _flaw("RDM613", "4.3", "a vertex of a block is not used"),
    _flaw("RDM614", "4.3", "a triangle names one vertex twice"),
    _flaw("RDM615", "4.3", "a coordinate is not a finite number, or not an exact one"),
    _flaw("RDM701", "4.4", "an inner child is none of the nodes that it may be"),
    _flaw("RDM702", "4.4", "a node is not the child of exactly one slot"),
    _flaw("RDM703", "4.4", "a block is not the leaf of exactly one slot"),
    _flaw("RDM704", "4.4", "a run is not the leaf of exactly one slot of its block's nodes"),
    _flaw("RDM705", "4.4", "a slot is neither empty nor a box"),
    _flaw("RDM706", "4.4", "a node without inner children or without leaves has a first one"),
    _flaw("RDM707", "4.4", "a box does not hold what is below it"),
    _flaw("RDM708", "4.4", "a node has no child"),
    _flaw("RDM709", "4.4", "a node over blocks has other leaves than it says"),
    _flaw("RDM801", "4.5", "the runs of a block do not begin where those before them end"),
    _flaw("RDM802", "4.5", "a run is not in one strip of its block, or longer than the longest run"),
    _flaw("RDM803", "4.5", "a triangle is not in exactly one run"),
    _flaw("RDM804", "4.5", "a run does not say where its triangles' corners are"),
    _flaw("RDM901", "4.9", "the metadata are no JSON object in UTF-8"),
    _flaw("RDM902", "4.9", "the metadata are longer than 2^20 bytes"),
    _flaw("RDM903", "4.9", "generator, source or unit is not a string"),
    _flaw("RDM904", "4.9", "the metadata are nested deeper than 32 levels"),
)

ISSUES = {issue.code: issue for issue in _ALL}
"""Every issue by its code."""


def unreadable(code: str, where: str) -> UnreadableSceneError:
    """Make the error that refuses a scene for one issue."""
    issue = ISSUES[code]
    return UnreadableSceneError(f"{code} {issue.message}", where=where, remedy=issue.remedy)


def catalogue() -> str:
    """The catalogue as Markdown: the whole text of formats/reducem/ISSUES.md."""
    rows = [f"| {i.code} | {i.severity} | {i.clause} | {i.message} | {i.remedy} |\n" for i in _ALL]
    return _HEAD + "".join(rows)


_HEAD = """\
# Issues of a ReduceM scene file

What `striptools.reducem.validate` finds and what the reader refuses. A file is valid when it has no issue of
severity `error`. The clause is the section of SPEC.md that rules the flaw out. Codes are never used again for
something else; those from RDM301 to RDM499 were of formats before 0.3. `python -m striptools.reducem.issues`
prints this file, and a test compares the two.

| code | severity | clause | message | remedy |
|---|---|---|---|---|
"""

if __name__ == "__main__":
    sys.stdout.write(catalogue())
