"""OPC UA: what a PLC calls and a SCADA reads.

    async with opcua_server(service, port=4840):
        ...

One object, Cell, in the namespace `urn:dengine:cell`: the methods Decide and Report, and read-only variables, by NodeIds of
text that stay as they are (`VARIABLES`). The variables follow the store, at most twice a second. The begin and the end of
an alarm are events of the Server object as well.
"""

import asyncio
import hmac
import logging
import os
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping
from contextlib import asynccontextmanager, suppress
from functools import wraps
from typing import Any

import numpy as np
from asyncua import ua
from asyncua.common.node import Node
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.event_generator import EventGenerator
from asyncua.server.internal_server import InternalServer
from asyncua.server.server import Server
from asyncua.server.user_managers import UserManager
from asyncua.ua import VariantType
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.status_codes import StatusCodes

from ..errors import DengineError, SettingError, as_options
from .auth import host_in_url, is_loopback
from .robot_calls import RobotCalls, one_line
from .service import CellService

log = logging.getLogger("dengine")
MOST, CHUNK = 1 << 20, 65535  # bytes of a message, 250,000 samples; and of a message's part
CONNECTIONS, SUBSCRIPTIONS = 50, 100
USER = "dengine"


class Users(UserManager):
    """Who may read and call: everybody on this machine, or who knows a token. Nobody is an administrator.

    encrypted : only who shows a certificate, as whoever encrypts does: asyncua lets anyone open a channel without security,
    so that a client can ask what the endpoints are, and would let a session begin on it.
    """

    def __init__(self, tokens: Collection[str] | None, encrypted: bool = False) -> None:
        self._tokens, self._encrypted = tokens, encrypted

    def get_user(
        self, iserver: InternalServer, username: str | None = None, password: Any = None, certificate: Any = None
    ) -> User | None:
        """The user of this name and password; None where there is none."""
        if self._encrypted and not certificate:
            return None
        if self._tokens is None:
            return User(role=UserRole.User, name="anyone")
        given = password if isinstance(password, bytes) else str(password or "").encode("utf-8", "surrogateescape")
        same = sum(hmac.compare_digest(given, each.encode()) for each in self._tokens)  # each is compared, whichever it is
        return User(role=UserRole.User, name=USER) if same and username == USER else None


NAMESPACE = "urn:dengine:cell"
CELL = "Cell"
EVERY, SELDOM = 0.5, 5.0  # seconds between two looks at the store, at least and at most
ALARM, ALARM_ENDED = 700, 100  # severities, of 1 to 1000
MOST_CHANNELS = 1000

VARIABLES: Mapping[str, tuple[VariantType, str, str]] = {  # its type, its name in `RobotCalls.status`, what it is
    "Decisions": (VariantType.UInt32, "decisions", "decisions since the cell's birth"),
    "VerifiedShare": (VariantType.Double, "verified_share", "verified share of the newest 500 decisions, 0 to 1"),
    "Accepted": (VariantType.UInt32, "accepted", "parts accepted without a check"),
    "Rejected": (VariantType.UInt32, "rejected", "parts that the model rejected"),
    "Bad": (VariantType.UInt32, "bad", "accepted parts that are known to have been bad"),
    "ModelVersion": (VariantType.UInt32, "version", "of the model that answers; 0 before the first retrain"),
    "SafeMode": (VariantType.Boolean, "safe_mode", "everything is verified, by the engine's own choice"),
    "SafeModeReason": (VariantType.String, "safe_mode", "why; empty where it is not"),
    "Shadow": (VariantType.Boolean, "shadow", "everything is verified, the model is only asked"),
    "Alarm": (VariantType.Boolean, "alarm", "somebody should look"),
    "AlarmText": (VariantType.String, "alarm", "at what; empty where there is nothing"),
    "Waiting": (VariantType.UInt32, "waiting", "requests in line"),
    "Late": (VariantType.UInt32, "late", "answers that came too late, since the server's start"),
    "Busy": (VariantType.UInt32, "busy", "requests that were refused since the line was full, since the start"),
    "LastRefused": (VariantType.String, "", "why the newest call was refused"),  # for who sets a PLC up
}

Argument = tuple[str, VariantType, bool, str]  # name, type, an array, what it is
DECIDE: tuple[list[Argument], list[Argument]] = (
    [
        ("Trace", VariantType.Float, True, "samples, channel by channel"),
        ("Channels", VariantType.UInt32, False, "1, or how many channels the trace has"),
        ("Request", VariantType.String, False, "an id of the caller's, once for every part; empty: one is made"),
        ("Part", VariantType.String, False, "the part's number; empty: none"),
    ],
    [
        ("Action", VariantType.Int32, False, "0 verify, 1 accept, 2 reject"),
        ("Id", VariantType.String, False, "for Report; empty: nothing was recorded, verify"),
        ("Reason", VariantType.String, False, "why, as in Reason; busy: the line is full"),
        ("Lower", VariantType.Double, False, "bound on the success probability, from below"),
        ("Upper", VariantType.Double, False, "and from above"),
        ("ModelVersion", VariantType.UInt32, False, "of the model that answered"),
    ],
)
REPORT: tuple[list[Argument], list[Argument]] = (
    [("Id", VariantType.String, False, "as Decide gave it"), ("Success", VariantType.Boolean, False, "True: good")],
    [("Kept", VariantType.Boolean, False, "False: nothing under this id was recorded, or the server is busy")],
)


@asynccontextmanager
async def opcua_server(
    service: CellService,
    port: int = 4840,
    host: str = "127.0.0.1",
    tokens: Collection[str] | None = None,
    cert: str | os.PathLike[str] | None = None,
    key: str | os.PathLike[str] | None = None,
) -> AsyncIterator[Server]:
    """Serve the cell over OPC UA in this loop, as long as the context lasts.

    port : 0 takes a free one, `server.bserver.port`.  tokens : passwords of the user `dengine`; None: anyone may ask.
    cert, key : PEM or DER files; with them only Basic256Sha256, signed and encrypted, is spoken.
    SettingError for an address other than this machine's without token, cert and key; OSError for a port in use.
    """
    secure = cert is not None and key is not None
    if not (is_loopback(host) or (secure and tokens)):
        raise SettingError(f"Expected a token, a certificate and a key to serve OPC UA on {host}; or stay on 127.0.0.1.")
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # it writes tracebacks of whatever strangers send
    server = Server(user_manager=Users(tokens, secure))
    server.limits.max_message_size, server.limits.max_chunk_count = MOST, MOST // CHUNK + 1
    server.iserver.max_connections, server.iserver.max_subscriptions = CONNECTIONS, SUBSCRIPTIONS
    server.set_identity_tokens([ua.AnonymousIdentityToken if tokens is None else ua.UserNameIdentityToken])
    await server.init()
    server.allow_remote_admin(False)
    server.set_endpoint(f"opc.tcp://{host_in_url(host)}:{port}/dengine")
    server.set_server_name("dengine")
    await server.set_application_uri("urn:dengine:server")
    policy = ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt if secure else ua.SecurityPolicyType.NoSecurity
    server.set_security_policy([policy])
    if cert is not None and key is not None:
        await server.load_certificate(os.fspath(cert))
        await server.load_private_key(os.fspath(key))
    space = AddressSpace(server, service)
    await space.build()
    async with server:
        await space.refresh()
        following = asyncio.create_task(space.follow())
        try:
            yield server
        finally:
            following.cancel()
            with suppress(asyncio.CancelledError):
                await following


class AddressSpace:
    """The nodes of one cell."""

    def __init__(self, server: Server, service: CellService) -> None:
        self._server, self._service, self._calls = server, service, RobotCalls(service)
        self._nodes: dict[str, Node] = {}
        self._alarm = ""

    async def build(self) -> None:
        """Make the object, its variables and methods, and what tells of alarms."""
        self._index = await self._server.register_namespace(NAMESPACE)
        cell = await self._server.nodes.objects.add_object(self._id(CELL), self._name(CELL))
        for name, (type_, _, text) in VARIABLES.items():
            first = ua.get_default_value(type_) if type_ is not VariantType.String else ""
            node = await cell.add_variable(self._id(f"{CELL}.{name}"), self._name(name), first, type_)
            await node.write_attribute(AttributeIds.Description, ua.DataValue(ua.Variant(ua.LocalizedText(text))))
            self._nodes[name] = node
        for name, call, (taken, given) in (("Decide", self.decide, DECIDE), ("Report", self.report, REPORT)):
            checked = self._checked(call, taken, given)
            arguments = [_argument(*each) for each in taken], [_argument(*each) for each in given]
            await cell.add_method(self._id(f"{CELL}.{name}"), self._name(name), checked, *arguments)
        self._events: EventGenerator = await self._server.get_event_generator()
        self._events.event.SourceNode, self._events.event.SourceName = cell.nodeid, CELL

    async def decide(self, trace: list[float], channels: int, request: str, part: str) -> list[Any]:
        """Decide on a trace, flat, channel by channel."""
        if not 1 <= channels <= MOST_CHANNELS or len(trace) % channels or not trace:
            raise SettingError(f"Expected as many samples of each channel, got {len(trace)} of {channels} channels.")
        x = np.array(trace, dtype=np.float32).reshape(channels, -1)
        answer = await self._calls.decide_on(x, request, part)
        return [answer[name] for name in ("action", "id", "reason", "lower", "upper", "version")]

    async def report(self, decision_id: str, success: bool) -> list[Any]:
        return [await self._calls.report(decision_id, success)]

    async def follow(self) -> None:
        """Bring the variables up to date whenever something has changed, and now and then, for ever."""
        async for _ in self._service.changes(SELDOM):
            await self.refresh()
            await asyncio.sleep(EVERY)  # what was decided just now is in the store by then

    async def refresh(self) -> None:
        """Bring the variables up to date; where that cannot be, the values stay, and say that they are old."""
        try:
            await self.update(await self._calls.status())
        except Exception as error:  # the store is away, or the line is full
            log.warning("the OPC UA variables could not be brought up to date: %s", error)
            for name in [name for name, (_, key, _) in VARIABLES.items() if key]:
                old = await self._nodes[name].read_data_value(raise_on_bad_status=False)
                status = _status(StatusCodes.UncertainLastUsableValue)
                await self._nodes[name].write_value(ua.DataValue(old.Value, status))

    async def update(self, now: Mapping[str, Any]) -> None:
        """Write how the cell is doing into the variables; an alarm that begins or ends is an event."""
        for name, (type_, key, _) in VARIABLES.items():
            if key:
                value = bool(now[key]) if type_ is VariantType.Boolean else now[key]
                await self._nodes[name].write_value(ua.DataValue(ua.Variant(value, type_)))
        if now["alarm"] != self._alarm:
            self._events.event.Severity = ALARM if now["alarm"] else ALARM_ENDED
            await self._events.trigger(message=now["alarm"] or f"Over: {self._alarm}")
            self._alarm = now["alarm"]

    def _checked(
        self, call: Callable[..., Awaitable[list[Any]]], taken: list[Argument], given: list[Argument]
    ) -> Callable[..., Awaitable[Any]]:
        """A method as asyncua calls it: what is wrong is a status, and a line in LastRefused; nothing is raised."""
        listed = ", ".join(f"{name} ({kind.name}{' array' if array else ''})" for name, kind, array, _ in taken)

        @wraps(call)
        async def method(parent: ua.NodeId, *arguments: ua.Variant) -> Any:
            wrong, got = _wrong(arguments, taken)
            said = f"Expected {listed}{got}."
            if wrong is None:
                try:
                    answer = await call(*map(_value, arguments, taken))
                    return [ua.Variant(value, type_) for value, (_, type_, _, _) in zip(answer, given, strict=True)]
                except DengineError as error:
                    wrong, said = StatusCodes.BadInvalidArgument, as_options(str(error))
                except Exception:  # ours: the log has it, the caller verifies
                    log.exception("a call over OPC UA failed")
                    wrong, said = StatusCodes.BadInternalError, "The server failed on this call."
            await self._nodes["LastRefused"].write_value(ua.DataValue(ua.Variant(one_line(said), VariantType.String)))
            return _status(wrong)

        return method

    def _id(self, text: str) -> ua.NodeId:
        return ua.NodeId(ua.String(text), ua.Int16(self._index))

    def _name(self, text: str) -> ua.QualifiedName:
        return ua.QualifiedName(text, self._index)


def _wrong(arguments: tuple[ua.Variant, ...], taken: list[Argument]) -> tuple[int | None, str]:
    """What is wrong with a call's arguments, a status, and what came; None and "" where nothing is wrong."""
    if len(arguments) < len(taken):
        return StatusCodes.BadArgumentsMissing, f", got {len(arguments)} of {len(taken)} arguments"
    if len(arguments) > len(taken):
        return StatusCodes.BadTooManyArguments, f", got {len(arguments)} arguments"
    for given, argument in zip(arguments, taken, strict=True):
        name, type_, array, _ = argument
        empty = given.Value is None
        if empty and type_ is VariantType.String and given.VariantType in (VariantType.String, VariantType.Null):
            continue  # controllers send an empty text as null
        if given.VariantType is not type_ or empty or isinstance(given.Value, list) is not array:
            form = "null" if empty else f"{given.VariantType.name}{' array' * isinstance(given.Value, list)}"
            return StatusCodes.BadInvalidArgument, f", got {name} as {form}"
    return None, ""


def _value(given: ua.Variant, argument: Argument) -> Any:
    """An argument's value; a null String is an empty one."""
    return "" if given.Value is None and argument[1] is VariantType.String else given.Value


def _status(code: int) -> ua.StatusCode:
    return ua.StatusCode(ua.UInt32(code))


def _argument(name: str, type_: VariantType, array: bool, text: str) -> ua.Argument:
    rank, dimensions = (ua.ValueRank.OneDimension, [0]) if array else (ua.ValueRank.Scalar, [])
    return ua.Argument(name, ua.NodeId(ua.Int32(type_.value)), rank, dimensions, ua.LocalizedText(text))
