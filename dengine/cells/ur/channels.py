"""What a channel of a trace is called, and which number of the controller it is."""

from __future__ import annotations

from ...errors import SettingError
from ...recordings.triggers import Trigger
from .protocol import NOT_FOUND, TYPES, type_of

AXES = ("FX_Base", "FY_Base", "FZ_Base", "MuX_Base", "MuY_Base", "MuZ_Base")
POSES = ("TCP_X", "TCP_Y", "TCP_Z", "TCP_RX", "TCP_RY", "TCP_RZ")
CHANNELS = {  # as recordings of UR cells call them; newtons and newton metres, metres and radians, in the robot's base
    **{name: f"actual_TCP_force[{i}]" for i, name in enumerate(AXES)},
    **{name: f"actual_TCP_pose[{i}]" for i, name in enumerate(POSES)},
}


def column_of(name: str) -> str:
    """The controller's number that a channel or a signal is: by a name of CHANNELS, or by its own, `actual_q[5]`."""
    column = CHANNELS.get(name, name)
    field, _, index = column.partition("[")
    kind = type_of(field)
    size = 0 if kind == NOT_FOUND else TYPES[kind][1]
    known = index == "" if size == 1 else index.endswith("]") and index[:-1].isdecimal() and int(index[:-1]) < size
    if not known:
        raise SettingError(
            f"Expected a channel among {', '.join(CHANNELS)}, or a number of the controller, as actual_q[5] or "
            f"output_double_register_24, got {name!r}."
        )
    return column


def fields_of(channels: tuple[str, ...], trigger: Trigger, also: tuple[str, ...] = ()) -> tuple[str, ...]:
    """The fields to ask the controller for, each once, `timestamp` first."""
    columns = [column_of(name) for name in (*channels, *trigger.signals)]
    fields = [column.partition("[")[0] for column in columns]
    return tuple(dict.fromkeys(("timestamp", *fields, *also)))
