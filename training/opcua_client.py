"""An OPC UA client of a served cell, in Python: what a PLC's program has to do.

    dengine serve --store try.db --opcua 4840
    python opcua_client.py --url opc.tcp://127.0.0.1:4840/dengine --parts 60

It plays recorded parts: Decide for each part, Report the result of the check, and at the end read
the variables that a panel shows. Once after each connection it looks up what a controller's program
looks up: the index of the namespace by its URI, and the nodes by their texts. Then it makes one
call for each part, with each argument in its exact type.

The types are those of PLCopen's mapping of IEC 61131-3, which the clients of Siemens and Beckhoff
use. An empty text is sent as an empty String or as a null one (--empty); the server takes both.
"""

import argparse
import asyncio
from typing import Any

import numpy as np
from asyncua import ua
from asyncua.client.client import Client
from asyncua.common.node import Node

from dengine import load_dataset

NAMESPACE = "urn:dengine:cell"
# Type of IEC 61131-3 -> type of OPC UA.
VARIANT_TYPES = {
    "REAL": ua.VariantType.Float,
    "LREAL": ua.VariantType.Double,
    "DINT": ua.VariantType.Int32,
    "UDINT": ua.VariantType.UInt32,
    "BOOL": ua.VariantType.Boolean,
    "STRING": ua.VariantType.String,
    "WSTRING": ua.VariantType.String,
}
ACTIONS = ("verify", "accept", "reject")
VARIABLES = (
    "Decisions",
    "VerifiedShare",
    "Accepted",
    "Rejected",
    "ModelVersion",
    "SafeMode",
    "Shadow",
    "Alarm",
    "AlarmText",
)


def to_variant(value: Any, iec_type: str) -> ua.Variant:
    """Return a value as a controller sends it; None is a null."""
    return ua.Variant(value, VARIANT_TYPES[iec_type])


class Controller:
    """A connected client.

    Parameters
    ----------
    client : Client
    index : int
        Of the cell's namespace.
    empty : str or None
        What it sends for an empty text: "" or None.
    """

    def __init__(self, client: Client, index: int, empty: str | None) -> None:
        self.client = client
        self.index = index
        self.empty = empty

    def node(self, text: str) -> Node:
        """Return the node of this text in the cell's namespace."""
        return self.client.get_node(ua.NodeId(ua.String(text), ua.Int16(self.index)))

    async def call(self, method: str, *arguments: ua.Variant) -> Any:
        """Call a method of the cell.

        A call that the server refuses raises; the variable LastRefused has the reason.
        """
        return await self.node("Cell").call_method(self.node(f"Cell.{method}").nodeid, *arguments)

    async def decide(self, trace: np.ndarray, part: str = "") -> tuple[int, str]:
        """Ask for a decision.

        Parameters
        ----------
        trace : array, shape (samples,) or (channels, samples)
        part : str, default ""
            The part's number, if it has one.

        Returns
        -------
        action : int
            Position in `ACTIONS`.
        decision_id : str
            "" if nothing was recorded; then verify the part.
        """
        n_channels = 1 if trace.ndim == 1 else len(trace)
        action, decision_id, *_ = await self.call(
            "Decide",
            to_variant(trace.ravel().tolist(), "REAL"),
            to_variant(n_channels, "UDINT"),
            to_variant(self.empty, "STRING"),
            to_variant(part or self.empty, "WSTRING"),
        )
        return action, decision_id

    async def report(self, decision_id: str, success: bool) -> bool:
        """Report the outcome of a part; return whether the server stored it."""
        is_stored: bool = await self.call(
            "Report", to_variant(decision_id, "STRING"), to_variant(success, "BOOL")
        )
        return is_stored

    async def read(self, name: str) -> Any:
        """Return the value of a variable."""
        return await self.node(f"Cell.{name}").read_value()


async def play(url: str, n_parts: int, empty: str | None) -> list[str]:
    """Play recorded parts; return lines with the counts of actions and the `VARIABLES`.

    The outcomes that a cell would learn are reported: those of verified parts, and line stops.

    Parameters
    ----------
    url : str
        Of the server.
    n_parts : int
    empty : str or None
        What is sent for an empty text.
    """
    data = load_dataset("insertion")
    counts = dict.fromkeys(ACTIONS, 0)
    async with Client(url) as client:
        plc = Controller(client, await client.get_namespace_index(NAMESPACE), empty)
        for i, (trace, label) in enumerate(zip(data.X[:n_parts], data.y[:n_parts], strict=True)):
            success = bool(label)
            action, decision_id = await plc.decide(trace, f"P{i}" if i % 2 else "")
            name = ACTIONS[action]
            counts[name] += 1
            # A check gives the outcome of a verified part, a line stop that of a bad accepted one.
            is_known = name == "verify" or (name == "accept" and not success)
            if decision_id and is_known:
                await plc.report(decision_id, success)
        lines = [", ".join(f"{n} {action}" for action, n in counts.items())]
        return lines + [f"{name}: {await plc.read(name)}" for name in VARIABLES]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--url", default="opc.tcp://127.0.0.1:4840/dengine", help="Of the server.")
    parser.add_argument("--parts", type=int, default=60, help="How many recorded parts are played.")
    parser.add_argument(
        "--empty", choices=("null", "text"), default="null", help="What an empty text is sent as."
    )
    arguments = parser.parse_args()
    empty_text = None if arguments.empty == "null" else ""
    print(*asyncio.run(play(arguments.url, arguments.parts, empty_text)), sep="\n")
