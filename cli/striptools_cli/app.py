"""The command line: which verb runs, and which exit code its end becomes.

Exit codes: 0 done, 1 issues found, 2 usage, 3 unreadable input or failed write; 130 and 143 after Ctrl-C and
termination. Every error is one line on standard error. Only the verb that was asked for is imported.
"""

import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from types import FrameType
from typing import Annotated

import typer

from striptools import __version__
from striptools.errors import EXIT_DONE, EXIT_UNREADABLE, EXIT_USAGE, StriptoolsError
from striptools_cli.streams import say

VERBS = {
    "convert": "Turn a mesh into a scene file, or a scene file back into a mesh.",
    "info": "Say what is in a scene file, and how many bytes each part takes.",
    "validate": "Name every rule of the format that a scene file breaks.",
    "verify": "Trace a scene file with JAX and prove it against its source mesh.",
    "render": "Draw a picture of a scene file with the same tracer.",
    "study": "Compare stripifiers or hierarchies on a mesh: memory, rays a second, quality.",
    "trade": "Measure what bytes, speed and error are traded for each other on a mesh.",
    "bench": "Repeat this project's figures on your models, and say what got worse.",
    "extremes": "Run extreme cases through every mode of tracing, and judge them exactly.",
    "doctor": "Print the environment, for bug reports.",
}
"""The verbs, with the line that the list of verbs shows."""

_EXIT_INTERRUPTED = 130
_EXIT_TERMINATED = 143
_TRACEBACK = "STRIPTOOLS_TRACEBACK"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: What follows the program's name; None takes it from the process, and then also turns a
            termination signal into an orderly end.

    Returns:
        The exit code.
    """
    if arguments is None:
        signal.signal(signal.SIGTERM, _terminate)
        arguments = sys.argv[1:]
    try:
        return _run(list(arguments))
    except KeyboardInterrupt:
        return _fail("interrupted", _EXIT_INTERRUPTED)
    except StriptoolsError as error:
        _show_traceback()
        return _fail(str(error), error.exit_code)
    except MemoryError:
        _show_traceback()
        return _fail("not enough memory", EXIT_UNREADABLE)
    except OSError as error:
        _show_traceback()
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", EXIT_UNREADABLE)
    except Exception as error:
        _show_traceback()
        usage = getattr(error, "format_message", None)
        if callable(usage):
            return _fail(f"{usage()} (see striptools --help)", EXIT_USAGE)
        return _fail(
            f"internal error: {type(error).__name__}: {error} (please report it with the output of "
            f"`striptools doctor`; {_TRACEBACK}=1 shows where it happened)",
            EXIT_UNREADABLE,
        )


def build_app(wanted: str | None) -> typer.Typer:
    """The command line with every verb in its list, and the wanted one ready to run.

    The others are stand-ins, so that no verb waits for the imports of another.
    """
    app = typer.Typer(
        name="striptools",
        help="Triangle meshes made ready for ray tracing.",
        add_completion=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback(invoke_without_command=True)(_global_options)
    for verb, summary in VERBS.items():
        function = import_module(f"striptools_cli.{verb}").run if verb == wanted else _stand_in
        app.command(verb, short_help=summary)(function)
    return app


def _run(arguments: list[str]) -> int:
    wanted = next((argument for argument in arguments if not argument.startswith("-")), None)
    if not arguments:
        arguments = ["--help"]
    command = typer.main.get_command(build_app(wanted))
    try:
        # Not `command()`: its own handling of a closed pipe and of Ctrl-C ends in other exit codes.
        with command.make_context("striptools", arguments) as context:
            command.invoke(context)
    except typer.Exit as end:
        return end.exit_code
    say("")
    return EXIT_DONE


def _global_options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and end.", is_eager=True)
    ] = False,
) -> None:
    if version:
        say(f"striptools {__version__}\n")
        raise typer.Exit(EXIT_DONE)


def _stand_in() -> None:
    raise AssertionError("a stand-in verb was called")


def _fail(line: str, code: int) -> int:
    sys.stderr.write(f"striptools: error: {' '.join(line.split())}\n")
    return code


def _show_traceback() -> None:
    if os.environ.get(_TRACEBACK):
        import traceback

        traceback.print_exc()


def _terminate(_signal: int, _frame: FrameType | None) -> None:
    sys.exit(_EXIT_TERMINATED)


if __name__ == "__main__":
    sys.exit(main())
