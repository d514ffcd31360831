"""`dengine run --cell ur`: which robot, and what was recorded of it."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from ..errors import SettingError

if TYPE_CHECKING:
    from ..cells.ur.cell import UrCell
    from .options import DataChoice

SAMPLES, RATE_HZ = 1000, 500.0  # of a trace, where nothing else was asked for: two seconds
RECORDED = ("samples", "rate_hz", "trigger")
host_option = click.option("--host", metavar="HOST[:PORT]", help="The robot's address, for --cell ur.")


def open_robot(address: str | None, source: DataChoice) -> UrCell:
    """The cell, connected, its program running. SettingError where no host was named; CellError where none answers."""
    from ..cells.ur.cell import UrCell
    from ..datasets.dataset import names_of

    if not address:
        raise SettingError("Expected the robot's address for --cell ur, as in --host 192.168.1.10, got none.")
    host, port = host_and_port(address)
    asked: dict[str, Any] = dict(source.how)
    how = {"samples": SAMPLES, "rate_hz": RATE_HZ} | {name: asked[name] for name in RECORDED if name in asked}
    how |= {"channels": names_of(asked["channel"])} if "channel" in asked else {}
    return UrCell(host, port=port, **how).open()


def host_and_port(address: str) -> tuple[str, int]:
    """A controller's host, and its port, RTDE's where none is named; SettingError for what is no port."""
    from ..cells.ur.protocol import PORT

    host, _, port = address.partition(":")
    if port and not port.isdecimal():
        raise SettingError(f"Expected a host, or host:port, got {address!r}.")
    return host, int(port) if port else PORT


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
