"""The `dengine` command: each subcommand parses its options, calls one function and prints the
result.

    dengine replay --data insertion --reducer conv --alpha 0.1 --lower-bound 0.9 --repeats 3

A subcommand is a function in one of this folder's modules and a name in the list at the end of this
one. Subcommands import what they need when they run, so that `--help` answers at once.
"""

import sys
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import click

from .. import __version__
from ..errors import DengineError, ImportRefusedError, as_options, without_password
from .data import data, simulate, train
from .export import export
from .history import explain, history
from .options import example_epilog
from .output import exit_interrupted
from .replay import compare, costs, replay
from .run import run
from .serve import serve
from .status import status
from .store import (
    backup,
    correct,
    forget,
    import_labels,
    policy,
    release,
    report,
    restore,
    retrain,
    rollback,
    verify,
)


class Verbs(click.Group):
    """The subcommands of `dengine`; an expected error is printed as one line on stderr.

    The exit code is then 1, or 2 for an error that the option `--allow-import` avoids. Any other
    exception passes with its traceback.
    """

    def main(self, *args: Any, **options: Any) -> Any:
        """Parse the arguments, run a subcommand, and usually end the process.

        The arguments are those of `click.Group.main`. Before that stdout and stderr, unless they
        are in UTF, are set to print "?" for a character that their encoding lacks.
        """
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TextIOWrapper) and not stream.encoding.lower().startswith("utf"):
                stream.reconfigure(errors="replace")
        return super().main(*args, **options)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a subcommand and return its result; raise its expected errors as errors of click.

        Expected are DengineError, OSError (but BrokenPipeError, which passes) and UnicodeError;
        they become `click.ClickException`, exit code 1. An ImportRefusedError, for a class of the
        user's that is imported only with `--allow-import`, becomes `click.UsageError`, exit code 2.
        The message is put on one line, and names the options of the command line in place of
        Python's arguments. Passwords are masked, also in the messages of click's own errors, which
        are raised again. The current folder is added to the end of `sys.path`, so that a class that
        is named as `module:Class` is found there. Ctrl-C ends the process with exit code 130. Other
        exceptions pass unchanged.
        """
        folder = str(Path.cwd())
        if folder not in sys.path:
            # `module:Class` is also searched in the current folder; last, so it shadows nothing.
            sys.path.append(folder)
        try:
            return super().invoke(ctx)
        except BrokenPipeError:  # `dengine status x.db | head`: click ends quietly
            raise
        # UnicodeError: a file name that no file system can have.
        except (DengineError, OSError, UnicodeError) as error:
            kind = (
                click.UsageError if isinstance(error, ImportRefusedError) else click.ClickException
            )
            text = " ".join(str(error).split())
            raise kind(as_options(without_password(text))) from error
        except click.ClickException as error:
            # click repeats the words that it was called with.
            error.message = without_password(error.message)  # type: ignore[misc]  # final for click
            raise
        except KeyboardInterrupt:
            exit_interrupted("Interrupted.")


@click.group(
    cls=Verbs,
    commands=[
        data,
        replay,
        compare,
        costs,
        train,
        run,
        serve,
        simulate,
        status,
        history,
        explain,
        verify,
        report,
        correct,
        forget,
        rollback,
        release,
        policy,
        retrain,
        backup,
        restore,
        export,
        import_labels,
    ],
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
    epilog=example_epilog("dengine replay --data insertion --reducer conv --repeats 3"),
)
@click.version_option(__version__, prog_name="dengine", message="%(prog)s %(version)s")
def main() -> None:
    """Let a robot cell start with a slow check, and need it less as it learns.

    Exit codes: 0 success; 1 failure, with one line that says why; 2 wrong usage; 130 interrupted by
    Ctrl-C, and what was done until then is kept and shown.
    """
