"""`dengine run --cell ur`: which robot, and when it records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import wraps
from typing import TYPE_CHECKING, Any

import click

from ..errors import SettingError

if TYPE_CHECKING:
    from ..cells.ur.cell import UrCell
    from .options import DataChoice

Command = Callable[..., Any]
SAMPLES, RATE_HZ = 1000, 500.0  # of a trace, where nothing else was asked for: two seconds


@dataclass(frozen=True)
class RobotChoice:
    """Which controller was asked for, and by what trigger it is recorded."""

    host: str | None = None
    trigger: str | None = None

    def open(self, source: DataChoice) -> UrCell:
        """The cell, connected, its program running. SettingError where no host was named; CellError where none answers."""
        from ..cells.ur.cell import UrCell
        from ..cells.ur.protocol import PORT
        from ..recordings.asked import names_of

        if not self.host:
            raise SettingError("Expected the robot's address for --cell ur, as in --host 192.168.1.10, got none.")
        host, _, port = self.host.partition(":")
        if port and not port.isdecimal():
            raise SettingError(f"Expected a host, or host:port, got {self.host!r}.")
        how: dict[str, Any] = {"samples": source.samples or SAMPLES, "rate_hz": source.rate_hz or RATE_HZ}
        how |= {"trigger": self.trigger} if self.trigger else {}
        how |= {"channels": names_of(source.channel)} if source.channel else {}
        return UrCell(host, port=int(port) if port else PORT, **how).open()


def robot_options(command: Command) -> Command:
    """`--host` and `--trigger`, handed on as one `RobotChoice`, `robot`."""

    @wraps(command)
    def chosen(host: str | None, trigger: str | None, **others: Any) -> Any:
        return command(robot=RobotChoice(host, trigger), **others)

    with_trigger = click.option(
        "--trigger",
        metavar="TEXT",
        help="When an insertion begins, for ur: register@output_int_register_25, bit=0, contact=5 (N), motion=0.01 (m/s).  "
        "[default: the first]",
    )
    with_host = click.option("--host", metavar="HOST[:PORT]", help="The robot's address, for --cell ur.")
    return with_host(with_trigger(chosen))


def recording_record(cell: Any) -> dict[str, Any] | None:
    """What was missing of what a cell recorded; None for one that records nothing."""
    recorder = getattr(cell, "recorder", None)
    return None if recorder is None else {"incomplete": cell.incomplete, **asdict(recorder.report())}


def recording_line(told: dict[str, Any]) -> str:
    """The same for people."""
    return (
        f"Recorded: {told['packages']} packages, {told['missing']} missing, {told['late']} late, {told['reconnects']} "
        f"reconnects. Traces with a gap, verified and never learned from: {told['incomplete']}."
    )
