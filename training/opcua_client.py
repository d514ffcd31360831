"""A PLC's side of a served cell over OPC UA, in Python: the calls, the types and the empty texts of a controller.

    dengine serve --store try.db --opcua 4840
    python training/opcua_client.py --url opc.tcp://127.0.0.1:4840/dengine --parts 60

It plays recorded parts: Decide on each, Report what the check found, and at the end the variables that a
panel shows. It looks up what a controller's program looks up, once after each connection: the namespace's
index by its URI, the nodes by their texts. Then it makes one call a part, each argument in its exact type.

The types are those of PLCopen's mapping of IEC 61131-3, which Siemens' and Beckhoff's clients keep to. An
empty text goes out as an empty String or as a null one (--empty); the server takes both.
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
IEC = {  # a controller's type: OPC UA's
    "REAL": ua.VariantType.Float,
    "LREAL": ua.VariantType.Double,
    "DINT": ua.VariantType.Int32,
    "UDINT": ua.VariantType.UInt32,
    "BOOL": ua.VariantType.Boolean,
    "STRING": ua.VariantType.String,
    "WSTRING": ua.VariantType.String,
}
ACTIONS = ("verify", "accept", "reject")
SHOWN = (
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


def argument(value: Any, kind: str) -> ua.Variant:
    """A value as a controller of this type sends it; None is a null."""
    return ua.Variant(value, IEC[kind])


class Controller:
    """A connected client.  empty : what it sends for an empty text, "" or None."""

    def __init__(self, client: Client, index: int, empty: str | None) -> None:
        self.client = client
        self.index = index
        self.empty = empty

    def node(self, text: str) -> Node:
        """The node of this text in the cell's namespace."""
        return self.client.get_node(ua.NodeId(ua.String(text), ua.Int16(self.index)))

    async def call(self, method: str, *arguments: ua.Variant) -> Any:
        """Call a method of the cell; a call that is refused raises, and LastRefused says why."""
        return await self.node("Cell").call_method(self.node(f"Cell.{method}").nodeid, *arguments)

    async def decide(self, trace: np.ndarray, part: str = "") -> tuple[int, str]:
        """Trace (samples,) or (channels, samples) -> action and id; "": nothing was recorded, verify."""
        channels = 1 if trace.ndim == 1 else len(trace)
        samples = argument(trace.ravel().tolist(), "REAL")
        texts = argument(self.empty, "STRING"), argument(part or self.empty, "WSTRING")
        action, id_, *_ = await self.call("Decide", samples, argument(channels, "UDINT"), *texts)
        return action, id_

    async def report(self, id_: str, success: bool) -> bool:
        """What became of a part; False: it is not kept."""
        kept: bool = await self.call("Report", argument(id_, "STRING"), argument(success, "BOOL"))
        return kept

    async def read(self, name: str) -> Any:
        """A variable's value."""
        return await self.node(f"Cell.{name}").read_value()


async def play(url: str, n_parts: int, empty: str | None) -> list[str]:
    """Play so many recorded parts; returns the lines that are printed."""
    data = load_dataset("insertion")
    counts = dict.fromkeys(ACTIONS, 0)
    async with Client(url) as client:
        plc = Controller(client, await client.get_namespace_index(NAMESPACE), empty)
        for i, (trace, good) in enumerate(zip(data.X[:n_parts], data.y[:n_parts], strict=True)):
            action, id_ = await plc.decide(trace, f"P{i}" if i % 2 else "")
            counts[ACTIONS[action]] += 1
            # Verified: the check tells. Accepted and bad: the system has stopped.
            if id_ and (ACTIONS[action] == "verify" or (ACTIONS[action] == "accept" and not good)):
                await plc.report(id_, bool(good))
        lines = [", ".join(f"{n} {action}" for action, n in counts.items())]
        return lines + [f"{name}: {await plc.read(name)}" for name in SHOWN]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--url", default="opc.tcp://127.0.0.1:4840/dengine", help="Of the server.")
    parser.add_argument("--parts", type=int, default=60, help="How many recorded parts are played.")
    parser.add_argument(
        "--empty", choices=("null", "text"), default="null", help="What an empty text is sent as."
    )
    asked = parser.parse_args()
    print(
        *asyncio.run(play(asked.url, asked.parts, None if asked.empty == "null" else "")), sep="\n"
    )
