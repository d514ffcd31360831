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

QUIET = 0.5  # seconds without an answer, after which the server waits for the rest of a message
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

    def play(self, rng: random.Random) -> tuple[str, bytes]:
        """Say it again up to a message that is spoilt; the outcome, and what the server said to that."""
        at = rng.randrange(len(self.messages))
        with socket.create_connection(("127.0.0.1", self.port), timeout=20) as server:
            channel, session = b"", self.token
            for i, message in enumerate(self.messages[:at]):
                server.sendall(_adapted(message, channel, self.token, session))
                answer = _read(server, 20.0)
                if i == 1:
                    channel = answer[8:12] + _channel_token(answer)
                session = _session_token(answer) if i == 2 else session
            server.sendall(self._spoilt(rng, _adapted(self.messages[at], channel, self.token, session)))
            return _outcome(_read(server, QUIET))

    def _spoilt(self, rng: random.Random, message: bytes) -> bytes:
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


def _read(server: socket.socket, seconds: float) -> bytes:
    """One message; b"" where the connection ended, b"?" where nothing came in time."""
    server.settimeout(seconds)
    said = b""
    try:
        while len(said) < 8 or len(said) < int.from_bytes(said[4:8], "little"):
            piece = server.recv(65536)
            if not piece:
                return b""
            said += piece
    except TimeoutError:
        return b"?"
    except ConnectionError:
        return b""
    return said


def _outcome(answer: bytes) -> tuple[str, bytes]:
    if answer in (b"", b"?"):
        return ("closed" if answer == b"" else "waiting"), answer
    if answer[:3] == b"ERR":
        return "refused", answer
    if answer[:3] != b"MSG":
        return "taken", answer
    kind, header, _ = _parts(answer)
    if not header.ServiceResult.is_good():
        return "refused", answer
    if kind.Identifier == ua.ObjectIds.CallResponse_Encoding_DefaultBinary:
        results = struct_from_binary(ua.CallResponse, _body(answer)).Results
        return ("taken" if any(each.StatusCode.is_good() for each in results) else "refused"), answer
    return "taken", answer


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
