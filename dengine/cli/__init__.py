"""The `dengine` command: each verb parses, calls one function and prints.

    dengine replay --data insertion --reducer conv --alpha 0.1 --lower-bound 0.9 --repeats 3

Only click is imported before a verb is known, so that `--help` answers at once.
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
from .options import ends_in
from .output import end_interrupted
from .replay import compare, costs, replay
from .run import run
from .serve import serve
from .status import status
from .store import backup, correct, forget, import_labels, policy, report, retrain, rollback, verify


class Verbs(click.Group):
    """A group whose foreseen failures are one line on stderr and exit code 1; 2 where an option would do."""

    def main(self, *args: Any, **options: Any) -> Any:
        """Run a verb; a character that the screen's encoding lacks becomes a question mark."""
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TextIOWrapper) and not stream.encoding.lower().startswith("utf"):
                stream.reconfigure(errors="replace")
        return super().main(*args, **options)

    def invoke(self, ctx: click.Context) -> Any:
        if (here := str(Path.cwd())) not in sys.path:  # where `module:Class` is looked for, last: it shadows nothing
            sys.path.append(here)
        try:
            return super().invoke(ctx)
        except BrokenPipeError:  # `dengine status x.db | head`: click ends quietly
            raise
        except (DengineError, OSError, UnicodeError) as error:  # the last of a name that no file system has
            kind = click.UsageError if isinstance(error, ImportRefusedError) else click.ClickException
            raise kind(as_options(without_password(" ".join(str(error).split())))) from error
        except click.ClickException as error:
            # click repeats the words that it was called with.
            error.message = without_password(error.message)  # type: ignore[misc]  # final for click, not for us
            raise
        except KeyboardInterrupt:
            end_interrupted("Interrupted.")


@click.group(
    cls=Verbs,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=ends_in("dengine replay --data insertion --reducer conv --repeats 3"),
)
@click.version_option(__version__, prog_name="dengine", message="%(prog)s %(version)s")
def main() -> None:
    """Let a robot cell start on its slow check, and earn its way off it.

    Exit codes: 0 done; 1 it failed, and one line says why; 2 a wrong call; 130 interrupted by Ctrl-C, what was done
    until then is kept and shown.
    """


for verb in (
    *(data, replay, compare, costs, train, run, serve, simulate, status, history, explain, verify),
    *(report, correct, forget, rollback, policy, retrain, backup, export, import_labels),
):
    main.add_command(verb)
