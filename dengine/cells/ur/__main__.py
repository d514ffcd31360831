"""A simulated controller that plays a data set, for `dengine run --cell ur` without a robot.

python -m dengine.cells.ur --port 30004 --speed 10
"""

import sys
import threading

import click

from ...errors import DengineError
from .controller import FakeController, RobotProgram
from .protocol import PORT


@click.command(help=__doc__)
@click.option(
    "--data", default="insertion", show_default=True, help="Anything that load_dataset takes."
)
@click.option("--host", default="127.0.0.1", show_default=True)
@click.option("--port", default=PORT, show_default=True, help="0: any that is free.")
@click.option(
    "--speed", default=1.0, show_default=True, help="Against real time; 0: as fast as it is read."
)
def main(data: str, host: str, port: int, speed: float) -> None:
    """Start a simulated controller that plays a data set, and run it until it is interrupted.

    Exit with a message if the data set cannot be loaded; a port that is taken raises OSError.
    """
    try:
        program = RobotProgram(data)
    except DengineError as error:
        sys.exit(str(error))
    with FakeController(program, host, port, speed or None) as fake:
        click.echo(
            f"A simulated controller at {host}:{fake.port}, {len(program.data)} parts; "
            "Ctrl-C ends it."
        )
        threading.Event().wait()


if __name__ == "__main__":
    main()
