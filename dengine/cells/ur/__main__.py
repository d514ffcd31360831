"""A controller without a robot, to drive `dengine run --cell ur` against: it plays a data set, part by part.

python -m dengine.cells.ur --port 30004 --speed 10
"""

from __future__ import annotations

import argparse
import sys
import threading

from ...errors import DengineError
from .controller import FakeController, RobotProgram
from .protocol import PORT


def main() -> None:
    """Listen until interrupted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="insertion", help="anything that load_dataset takes")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=PORT, help="0: any that is free")
    parser.add_argument("--speed", type=float, default=1.0, help="against real time; 0: as fast as it is read")
    asked = parser.parse_args()
    try:
        program = RobotProgram(asked.data)
    except DengineError as error:
        sys.exit(str(error))
    with FakeController(program, asked.host, asked.port, asked.speed or None) as fake:
        print(
            f"A controller without a robot at {fake.host}:{fake.port}, {len(program.data)} parts; Ctrl-C ends it.",
            flush=True,
        )
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            print(f"{len(program.played)} parts were inserted.")


if __name__ == "__main__":
    main()
