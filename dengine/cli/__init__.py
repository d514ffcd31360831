"""The `dengine` command: each verb parses, calls one function and prints.

    dengine replay --data insertion --reducer conv --alpha 0.1 --lower-bound 0.9 --repeats 3

Only click is imported before a verb is known, so that `--help` answers at once.
"""

from __future__ import annotations

from typing import Any

import click

from .. import __version__
from ..errors import DengineError
from .export import export, import_labels
from .replaying import compare, replay
from .running import run
from .simulating import simulate
from .status import status
from .training import train


class Verbs(click.Group):
    """A group whose foreseen failures are one line on stderr and exit code 1."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the verb."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError:  # `dengine status x.db | head`: click ends quietly
            raise
        except (DengineError, OSError) as error:
            raise click.ClickException(" ".join(str(error).split())) from error


@click.group(cls=Verbs, epilog="\b\nExample:\n  dengine replay --data insertion --reducer conv --repeats 3")
@click.version_option(__version__, prog_name="dengine", message="%(prog)s %(version)s")
def main() -> None:
    """Let a robot cell start on its slow check, and earn its way off it."""


for verb in (replay, compare, train, run, simulate, status, export, import_labels):
    main.add_command(verb)
