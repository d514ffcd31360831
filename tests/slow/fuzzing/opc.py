"""Malformed messages over OPC UA: a whole conversation is recorded once, and played again with one message spoilt."""

from __future__ import annotations

import asyncio
import logging
import random
import socket
import struct
from typing import Any

from asyncua import Client, ua
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import nodeid_from_binary, nodeid_to_binary, struct_from_binary

from .web import SAMPLES, spoilt
from .wire import WAIT, Call

KINDS = (b"MSGC", b"MSGX", b"OPNC", b"HELA", b"ACKF", b"ERRF", b"RHEF", b"\0\0\0\0")  # of messages, but no client's
OTHERS = (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00", b"HEL", b"MSG")
VALUES = [  # in the place of a trace
    *(b"\x80" + struct.pack("<i", 2**31 - 1), b"\x8c" + struct.pack("<ii", 2**31 - 1, -4)),
    *(b"\x98" + struct.pack("<i", 2**30), b"\x8a" + struct.pack("<i", -9), b"\xca" + struct.pack("<iii", 0, 1, -5)),
    *(b"\xca" + struct.pack("<iiiii", 0, 3, 2000, 2000, 2000), b"\x98" * 900, b"\x00", b"\x3f", b"\x16" * 40),
]


class Conversation:
    """A client's messages, from hello to a call of Decide, and what must be changed in them when they are said again."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.messages: list[bytes] = []
        self.answers: list[bytes] = []
        asyncio.run(self._record())
        self.token = _session_token(self.answers[2])

    async def _record(self) -> None:
        async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            up_reader, up_writer = await asyncio.open_connection("127.0.0.1", self.port)
            while message := await _message(reader):
                up_writer.write(message)
                self.messages.append(message)
                answer = await _message(up_reader)
                self.answers.append(answer)
                writer.write(answer)
            up_writer.close()
            writer.close()
            done.set()

        logging.getLogger("asyncua").setLevel(logging.ERROR)
        done = asyncio.Event()
        between = await asyncio.start_server(relay, "127.0.0.1", 0)
        port = between.sockets[0].getsockname()[1]
        client = Client(f"opc.tcp://127.0.0.1:{port}/dengine", timeout=20)
        client.name = "fuzz"
        await client.connect()
        index = await client.get_namespace_index("urn:dengine:cell")
        cell = client.get_node(ua.NodeId("Cell", index))
        await client.get_node(ua.NodeId("Cell.VerifiedShare", index)).read_value()
        await cell.get_children()
        trace = ua.Variant(
            [1.0] * (SAMPLES - 1), ua.VariantType.Float
        )  # one sample less: refused, but for a lucky spoiling
        others = [ua.Variant(1, ua.VariantType.UInt32), *[ua.Variant("", ua.VariantType.String)] * 2]
        try:
            await cell.call_method(ua.NodeId("Cell.Decide", index), trace, *others)
        except ua.UaStatusCodeError as error:
            if error.code != ua.StatusCodes.BadInvalidArgument:
                raise
        await client.disconnect()
        await done.wait()
        between.close()
        self.messages = [each for each in self.messages if each[:3] != b"CLO"]

    def play(self, rng: random.Random) -> Call:
        """Say it again up to a message that is spoilt; what the server says to that is still to come."""
        at = rng.randrange(len(self.messages))
        server = socket.create_connection(("127.0.0.1", self.port), timeout=WAIT)
        channel, session = b"", self.token
        for i, message in enumerate(self.messages[:at]):
            good = _call(server, _adapted(message, channel, self.token, session))
            good.wait(WAIT)
            if i == 1:
                channel = good.said[8:12] + _channel_token(good.said)
            session = _session_token(good.said) if i == 2 else session
        return _call(server, self._spoilt(rng, _adapted(self.messages[at], channel, self.token, session)))

    def _spoilt(self, rng: random.Random, message: bytes) -> bytes:
        match rng.randrange(12):
            case 0:
                return message[: rng.randrange(1, len(message))]
            case 1:
                return rng.choice(KINDS) + message[4:]
            case 2:
                return rng.choice((*OTHERS, rng.randbytes(rng.choice((1, 10, 3000)))))
        here = message.find(b"\x8a" + struct.pack("<i", SAMPLES - 1))
        if here >= 0 and rng.random() < 0.6:
            message = message[:here] + rng.choice(VALUES) + rng.randbytes(rng.choice((0, 20)))
            return message[:4] + struct.pack("<I", len(message)) + message[8:]
        damaged = spoilt(rng, message[8:])
        length = len(damaged) + 8 if rng.random() < 0.8 else rng.choice((0, 8, 2**31, 2**32 - 1))
        return message[:4] + struct.pack("<I", length) + damaged


async def _message(reader: asyncio.StreamReader) -> bytes:
    try:
        head = await reader.readexactly(8)
        return head + await reader.readexactly(int.from_bytes(head[4:], "little") - 8)
    except (asyncio.IncompleteReadError, ConnectionError):
        return b""


def _call(server: socket.socket, sent: bytes) -> Call:
    return Call(server, sent, _is_whole, _judged)


def _is_whole(said: bytes) -> bool:
    return len(said) >= 8 and len(said) >= int.from_bytes(said[4:8], "little")


def _judged(answer: bytes) -> str:
    """The outcome of an answer: refused by the transport, by a service, or by every one of a call's results."""
    if answer[:3] == b"ERR":
        return "late" if int.from_bytes(answer[8:12], "little") == ua.StatusCodes.BadTimeout else "refused"
    if answer[:3] != b"MSG":
        return "taken"
    kind, header, _ = _parts(answer)
    if not header.ServiceResult.is_good():
        return "refused"
    if kind.Identifier == ua.ObjectIds.CallResponse_Encoding_DefaultBinary:
        results = struct_from_binary(ua.CallResponse, _body(answer)).Results
        return "taken" if any(each.StatusCode.is_good() for each in results) else "refused"
    return "taken"


def _body(answer: bytes) -> Buffer:
    return Buffer(answer[24:])


def _parts(answer: bytes) -> tuple[Any, Any, Buffer]:
    rest = _body(answer)
    return nodeid_from_binary(rest), struct_from_binary(ua.ResponseHeader, rest), rest


def _session_token(answer: bytes) -> bytes:
    _, _, rest = _parts(answer)
    nodeid_from_binary(rest)
    return bytes(nodeid_to_binary(nodeid_from_binary(rest)))


def _channel_token(answer: bytes) -> bytes:
    """Of the answer to an OpenSecureChannel request without security: the last but three numbers of its end."""
    uri = int.from_bytes(answer[12:16], "little")
    rest = Buffer(answer[16 + uri + 8 + 8 :])
    nodeid_from_binary(rest)
    struct_from_binary(ua.ResponseHeader, rest)
    rest.read(8)
    return rest.read(4)


def _adapted(message: bytes, channel: bytes, before: bytes, session: bytes) -> bytes:
    if message[:3] != b"MSG":
        return message
    message = message[:8] + channel + message[16:]
    return message.replace(before, session, 1) if len(before) == len(session) else message
