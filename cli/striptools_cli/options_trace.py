"""Options that several verbs that trace have; apart from the others, as these bring JAX."""

from typing import Annotated, Any, Literal

import typer

from striptools.trace.device import DeviceKind

Up = Annotated[
    Literal["x", "y", "z", "-x", "-y", "-z"], typer.Option(help="The model's axis that points up.")
]

Device = Annotated[DeviceKind, typer.Option(help="Where to trace; auto takes a GPU if there is one.")]

TraceThreads = Annotated[
    int | None, typer.Option(min=1, metavar="N", help="Threads to trace with.", show_default="every core")
]


def side_option(most: int, default: int) -> Any:
    """`--side`, of a picture with a primary ray a pixel; `--quick` changes its default."""
    return typer.Option(min=8, max=most, metavar="N", help="N x N primary rays.", show_default=str(default))


def runs_option(default: int) -> Any:
    """`--runs`; `--quick` changes its default."""
    return typer.Option(min=1, metavar="N", help="Runs to take the median of.", show_default=str(default))
