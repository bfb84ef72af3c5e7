"""Arguments and options that several verbs have; those of verbs that trace are in `options_trace`."""

from typing import Annotated, Any

import typer

SceneFile = Annotated[str, typer.Argument(metavar="FILE.rdm", help="Scene file; - for standard input.")]

Threads = Annotated[
    int | None, typer.Option(min=1, metavar="N", help="Threads to use.", show_default="every core")
]


def from_option(name: str) -> Any:
    """`--from`, the format of an argument that is called so."""
    return typer.Option("--from", metavar="FORMAT", help=f"Format of {name}.", show_default="extension")


def format_option(what: str) -> Any:
    """`--format`, of what is printed."""
    return typer.Option("--format", help=f"How to print {what}.")


def quiet_option(but: str = "errors") -> Any:
    """`--quiet`, but for what is said all the same."""
    return typer.Option("--quiet", "-q", help=f"Say nothing but {but}.")
