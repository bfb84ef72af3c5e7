"""One record, four shapes, and nothing lost between them."""

import csv
import io
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from striptools_cli.report import flatten, human_bytes, human_value, render, render_table

_NAMES = st.text("abcdefghij_", min_size=1, max_size=8)
_VALUES = st.one_of(
    st.integers(-(2**53), 2**53),
    st.floats(allow_nan=False, allow_infinity=False),
    st.booleans(),
    st.none(),
    st.text('ab,|"\\\n é', max_size=6),
)
_GROUPS = st.dictionaries(_NAMES, _VALUES, max_size=3)
_RECORDS = st.dictionaries(_NAMES, st.one_of(_VALUES, _GROUPS), max_size=4)


@given(_RECORDS)
def test_json_gives_every_value_back(record: dict) -> None:
    assert json.loads(render(record, "json")) == record


@given(_RECORDS)
def test_csv_has_a_row_for_every_value(record: dict) -> None:
    rows = list(csv.reader(io.StringIO(render(record, "csv"), newline="")))
    assert rows[0] == ["name", "value"]
    assert [row[0] for row in rows[1:]] == [name for name, _ in flatten(record)]
    for row, (_, value) in zip(rows[1:], flatten(record), strict=True):
        if isinstance(value, float):
            assert float(row[1]) == value


@given(_RECORDS)
def test_markdown_is_one_table_of_two_columns(record: dict) -> None:
    lines = render(record, "md", "a | title").split("\n")
    assert lines[0] == "## a \\| title"
    assert lines[2:4] == ["| name | value |", "|---|---|"]
    rows = lines[4:-1]
    assert len(rows) == len(list(flatten(record)))
    for row in rows:
        assert row.replace("\\|", "").count("|") == 3


def test_text_aligns_values_and_indents_groups() -> None:
    record = {
        "triangles": 1234567,
        "bytes": {"positions": 12, "strip_vertices": 345},
        "remap": True,
        "view": None,
    }
    assert render(record, "text", "bunny.rdm") == (
        "bunny.rdm\n"
        "  triangles         1,234,567\n"
        "  bytes\n"
        "    positions       12\n"
        "    strip vertices  345\n"
        "  remap             yes\n"
        "  view              none\n"
    )


def test_json_has_null_for_what_it_cannot_say() -> None:
    assert json.loads(render({"a": math.inf, "b": [math.nan, 1.0]}, "json")) == {"a": None, "b": [None, 1.0]}


def test_numpy_scalars_are_numbers() -> None:
    record = {"count": np.int32(7), "size": np.float32(0.5), "yes": np.bool_(True)}
    assert json.loads(render(record, "json")) == {"count": 7, "size": 0.5, "yes": True}
    assert render(record, "csv") == "name,value\ncount,7\nsize,0.5\nyes,true\n"


@pytest.mark.parametrize(
    ("count", "said"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (1000, "1.0 kB"),
        (999_949, "999.9 kB"),
        (999_950, "1.0 MB"),
        (1_321_048, "1.3 MB"),
    ],
)
def test_bytes_are_in_decimal_units(count: int, said: str) -> None:
    assert human_bytes(count) == said


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (0.0012345, "0.001234"),
        (12345.6, "12,346"),
        (math.inf, "inf"),
        ([1, 2.5], "1, 2.5"),
        ([], "none"),
        ("x", "x"),
    ],
)
def test_values_as_people_read_them(value: object, said: str) -> None:
    assert human_value(value) == said


def test_a_table_has_a_row_a_record_in_every_format() -> None:
    rows = [
        {"name": "a|b", "count": 1234567, "share_of": 0.123456},
        {"name": "c", "count": 2, "share_of": None},
    ]
    text = render_table(rows, "text", "Things").splitlines()
    assert text[:2] == ["Things", "  name      count  share of"]
    assert text[2:] == ["  a|b   1,234,567    0.1235", "  c             2      none"]
    assert json.loads(render_table(rows, "json", "Things")) == rows
    assert list(csv.DictReader(io.StringIO(render_table(rows, "csv"))))[1] == {
        "name": "c",
        "count": "2",
        "share_of": "",
    }
    lines = render_table(rows, "md", "Things").splitlines()
    assert lines[:4] == ["## Things", "", "| name | count | share_of |", "| --- | --- | --- |"]
    assert lines[4] == "| a\\|b | 1234567 | 0.123456 |"
