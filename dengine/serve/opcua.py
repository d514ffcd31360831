"""`opcua_server` serves a cell over OPC UA: methods for a PLC to call, and variables for a SCADA
system to read. `dengine serve --opcua` starts it.

    async with opcua_server(service, port=4840):
        ...

The namespace `urn:dengine:cell` has one object, Cell, with the methods Decide and Report and
read-only variables (`VARIABLES`). The text NodeIds do not change between versions. The variables
follow the store, at most twice a second. The begin and the end of an alarm are events of the Server
object.
"""

import asyncio
import hmac
import logging
import os
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping
from contextlib import asynccontextmanager, suppress
from functools import wraps
from typing import Any, NamedTuple

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

from ..errors import DengineError, SettingError, as_options, log
from ..files import FilePath
from .auth import host_in_url, is_loopback
from .robot_calls import RobotCalls, one_line
from .service import CellService

PORT = 4840
MAX_MESSAGE = 1 << 20  # bytes, 250,000 samples
CHUNK = 65535  # bytes of a part of a message
MAX_CONNECTIONS = 50
MAX_SUBSCRIPTIONS = 100
MAX_CHANNELS = 1000
USER = "dengine"
NAMESPACE = "urn:dengine:cell"
CELL = "Cell"
MIN_REFRESH = 0.5  # seconds between two readings of the store
MAX_REFRESH = 5.0
ALARM = 700  # severity, of 1 to 1000
ALARM_ENDED = 100


class Variable(NamedTuple):
    """A read-only variable; `key` is its name in `RobotCalls.status`, "" if it is not there."""

    type: VariantType
    key: str
    description: str


class Argument(NamedTuple):
    """An argument or a result of a method."""

    name: str
    type: VariantType
    description: str
    is_array: bool = False


VARIABLES: Mapping[str, Variable] = {
    "Decisions": Variable(VariantType.UInt32, "decisions", "decisions so far"),
    "VerifiedShare": Variable(
        VariantType.Double, "verified_share", "verified share of the newest 500 decisions, 0 to 1"
    ),
    "Accepted": Variable(VariantType.UInt32, "accepted", "parts accepted without a check"),
    "Rejected": Variable(VariantType.UInt32, "rejected", "parts that the model rejected"),
    "Bad": Variable(VariantType.UInt32, "bad", "accepted parts that are known to be bad"),
    "ModelVersion": Variable(
        VariantType.UInt32, "version", "of the model that decides; 0 before the first retrain"
    ),
    "SafeMode": Variable(
        VariantType.Boolean, "safe_mode", "every part is verified, by the engine's own choice"
    ),
    "SafeModeReason": Variable(VariantType.String, "safe_mode", "why; empty outside the safe mode"),
    "Shadow": Variable(
        VariantType.Boolean, "shadow", "every part is verified, the model only predicts"
    ),
    "Alarm": Variable(VariantType.Boolean, "alarm", "somebody should look"),
    "AlarmText": Variable(VariantType.String, "alarm", "at what; empty without an alarm"),
    "Waiting": Variable(VariantType.UInt32, "waiting", "requests in the queue"),
    "Late": Variable(
        VariantType.UInt32, "late", "decisions past the deadline since the server's start"
    ),
    "Busy": Variable(
        VariantType.UInt32, "busy", "requests refused because the queue was full, since the start"
    ),
    # For the engineer who configures a PLC.
    "LastRefused": Variable(VariantType.String, "", "why the newest refused call was refused"),
}
DECIDE_ARGUMENTS = [
    Argument("Trace", VariantType.Float, "samples, channel by channel", is_array=True),
    Argument("Channels", VariantType.UInt32, "1, or how many channels the trace has"),
    Argument(
        "Request",
        VariantType.String,
        "an id of the caller's, a different one for each part; empty: a new one",
    ),
    Argument("Part", VariantType.String, "the part's number; empty: none"),
]
DECIDE_RESULTS = [
    Argument("Action", VariantType.Int32, "0 verify, 1 accept, 2 reject"),
    Argument("Id", VariantType.String, "for Report; empty: nothing was recorded, verify"),
    Argument("Reason", VariantType.String, "why, as in Reason; busy: the queue is full"),
    Argument("Lower", VariantType.Double, "lower bound of the success probability"),
    Argument("Upper", VariantType.Double, "upper bound of it"),
    Argument("ModelVersion", VariantType.UInt32, "of the model that decided"),
]
REPORT_ARGUMENTS = [
    Argument("Id", VariantType.String, "as Decide returned it"),
    Argument("Success", VariantType.Boolean, "True: good"),
]
REPORT_RESULTS = [
    Argument(
        "Kept",
        VariantType.Boolean,
        "False: nothing under this id was recorded, or the server is busy",
    )
]


class TokenUsers(UserManager):
    """Who may read and call: the user `dengine` with a token as the password. Nobody administers.

    Parameters
    ----------
    tokens : collection of str or None
        None: everybody.
    encrypted : bool
        Only clients with a certificate, which every client that encrypts has. asyncua lets anyone
        open a channel without security, to ask for the endpoints, and would accept a session on it.
    """

    def __init__(self, tokens: Collection[str] | None, encrypted: bool = False) -> None:
        self._tokens = tokens
        self._encrypted = encrypted

    def get_user(
        self,
        iserver: InternalServer,
        username: str | None = None,
        password: Any = None,
        certificate: Any = None,
    ) -> User | None:
        """Return the user of a new session, who may read and call; or None to refuse the session.

        It is None without a certificate if the server encrypts, and for a wrong user name or token
        if it has tokens.
        """
        if self._encrypted and not certificate:
            return None
        if self._tokens is None:
            return User(role=UserRole.User, name="anyone")
        if isinstance(password, bytes):
            secret = password
        else:
            secret = str(password or "").encode("utf-8", "surrogateescape")
        # All are compared, so that the time does not show which one matches.
        matches = sum(hmac.compare_digest(secret, token.encode()) for token in self._tokens)
        if matches and username == USER:
            return User(role=UserRole.User, name=USER)
        return None


@asynccontextmanager
async def opcua_server(
    service: CellService,
    port: int = PORT,
    host: str = "127.0.0.1",
    tokens: Collection[str] | None = None,
    cert: FilePath | None = None,
    key: FilePath | None = None,
) -> AsyncIterator[Server]:
    """Serve a cell over OPC UA in this event loop, as long as the context lasts.

    The logger of asyncua is set to CRITICAL, and stays so.

    Parameters
    ----------
    service : CellService
    port : int
        0: a free one, `server.bserver.port`.
    host : str
    tokens : collection of str, optional
        Passwords of the user `dengine`; None: everybody may read and call.
    cert, key : path, optional
        PEM or DER files. With both the server speaks only Basic256Sha256, signed and encrypted;
        else it encrypts nothing.

    Yields
    ------
    Server
        It listens, and its variables have the present status.

    Raises
    ------
    SettingError
        For an address that other machines can reach, unless there are tokens, a certificate and a
        key; for a certificate without its key, or a key alone.
    OSError
        For a port in use, and a file that cannot be read.
    """
    if (cert is None) != (key is None):
        raise SettingError("Expected a certificate and its key together, got one of them.")
    is_secure = cert is not None
    if not (is_loopback(host) or (is_secure and tokens)):
        raise SettingError(
            f"Expected a token, a certificate and a key to serve OPC UA on {host}; or stay on "
            "127.0.0.1."
        )
    # asyncua logs tracebacks of whatever strangers send.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    server = Server(user_manager=TokenUsers(tokens, is_secure))
    server.limits.max_message_size = MAX_MESSAGE
    server.limits.max_chunk_count = MAX_MESSAGE // CHUNK + 1
    server.iserver.max_connections = MAX_CONNECTIONS
    server.iserver.max_subscriptions = MAX_SUBSCRIPTIONS
    identity = ua.AnonymousIdentityToken if tokens is None else ua.UserNameIdentityToken
    server.set_identity_tokens([identity])
    await server.init()
    server.allow_remote_admin(False)
    server.set_endpoint(f"opc.tcp://{host_in_url(host)}:{port}/dengine")
    server.set_server_name("dengine")
    await server.set_application_uri("urn:dengine:server")
    if is_secure:
        policy = ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt
    else:
        policy = ua.SecurityPolicyType.NoSecurity
    server.set_security_policy([policy])
    if cert is not None and key is not None:
        await server.load_certificate(os.fspath(cert))
        await server.load_private_key(os.fspath(key))
    space = AddressSpace(server, service)
    await space.build()
    async with server:
        await space.refresh()
        following = asyncio.create_task(space.follow_changes())
        try:
            yield server
        finally:
            following.cancel()
            with suppress(asyncio.CancelledError):
                await following


class AddressSpace:
    """The nodes of one cell in an OPC UA server: its variables, methods and alarm events.

    Parameters
    ----------
    server : Server
        Initialized, not started.
    service : CellService
    """

    def __init__(self, server: Server, service: CellService) -> None:
        self._server = server
        self._service = service
        self._calls = RobotCalls(service)
        self._nodes: dict[str, Node] = {}
        self._alarm = ""

    async def build(self) -> None:
        """Create the object Cell, its `VARIABLES`, the methods Decide and Report, and the generator
        of alarm events; call it once, before the server starts.
        """
        self._index = await self._server.register_namespace(NAMESPACE)
        objects = self._server.nodes.objects
        cell = await objects.add_object(self._node_id(CELL), self._browse_name(CELL))
        for name, variable in VARIABLES.items():
            first = ""
            if variable.type is not VariantType.String:
                first = ua.get_default_value(variable.type)
            node = await cell.add_variable(
                self._node_id(f"{CELL}.{name}"), self._browse_name(name), first, variable.type
            )
            text = ua.Variant(ua.LocalizedText(variable.description))
            await node.write_attribute(AttributeIds.Description, ua.DataValue(text))
            self._nodes[name] = node
        for name, call, arguments, results in (
            ("Decide", self.decide, DECIDE_ARGUMENTS, DECIDE_RESULTS),
            ("Report", self.report, REPORT_ARGUMENTS, REPORT_RESULTS),
        ):
            await cell.add_method(
                self._node_id(f"{CELL}.{name}"),
                self._browse_name(name),
                self._as_method(call, arguments, results),
                [_as_ua_argument(argument) for argument in arguments],
                [_as_ua_argument(result) for result in results],
            )
        self._events: EventGenerator = await self._server.get_event_generator()
        self._events.event.SourceNode = cell.nodeid
        self._events.event.SourceName = CELL

    async def decide(self, trace: list[float], channels: int, request: str, part: str) -> list[Any]:
        """Decide on a flat trace, channel after channel.

        Returns a list of action (0 verify, 1 accept, 2 reject), id, reason, lower, upper, version.

        If the queue is full or the service closing, the result is VERIFY with an empty id. Raises
        SettingError for an empty trace, one that the channels do not divide, and other than 1 to
        `MAX_CHANNELS` channels; TraceError for a trace, and ReportError for a request, that the
        engine does not take.
        """
        if not 1 <= channels <= MAX_CHANNELS or len(trace) % channels or not trace:
            raise SettingError(
                f"Expected as many samples of each channel, got {len(trace)} of {channels} "
                "channels."
            )
        samples = np.array(trace, dtype=np.float32).reshape(channels, -1)
        result = await self._calls.decide_array(samples, request, part)
        return [result[key] for key in ("action", "id", "reason", "lower", "upper", "version")]

    async def report(self, decision_id: str, success: bool) -> list[Any]:
        """Report an outcome, True for good; return a list of one bool, whether the label is on
        disk.

        It is False for an unknown or empty id, and if the report cannot be stored now. Raises
        ReportError for a report that contradicts an earlier one, unless it is a line stop after a
        confirmation.
        """
        return [await self._calls.report(decision_id, success)]

    async def follow_changes(self) -> None:
        """Refresh the variables after each change, and at least every `MAX_REFRESH` seconds.

        It refreshes at most once in `MIN_REFRESH` seconds, and ends when the service ends
        listening.
        """
        async for _ in self._service.changes(MAX_REFRESH):
            await self.refresh()
            await asyncio.sleep(MIN_REFRESH)  # meanwhile the newest decisions reach the store

    async def refresh(self) -> None:
        """Read the cell's status and write it into the variables.

        If it cannot be read, that is logged, and the variables keep their values, with a status
        that says that these are old.
        """
        try:
            await self.write_status(await self._calls.status())
        except Exception as error:  # the store is unavailable, or the queue full
            log.warning("the OPC UA variables could not be brought up to date: %s", error)
            status = _status_code(StatusCodes.UncertainLastUsableValue)
            for name, variable in VARIABLES.items():
                if variable.key:
                    node = self._nodes[name]
                    old = await node.read_data_value(raise_on_bad_status=False)
                    await node.write_value(ua.DataValue(old.Value, status))

    async def write_status(self, status: Mapping[str, Any]) -> None:
        """Write a status, as `RobotCalls.status` returns it, into the variables.

        If the text of the alarm has changed since the last call, send an event; an empty text sends
        the event that the alarm has ended.
        """
        for name, variable in VARIABLES.items():
            if variable.key:
                value = status[variable.key]
                if variable.type is VariantType.Boolean:
                    value = bool(value)
                data = ua.DataValue(ua.Variant(value, variable.type))
                await self._nodes[name].write_value(data)
        alarm = status["alarm"]
        if alarm != self._alarm:
            self._events.event.Severity = ALARM if alarm else ALARM_ENDED
            await self._events.trigger(message=alarm or f"Over: {self._alarm}")
            self._alarm = alarm

    def _as_method(
        self,
        call: Callable[..., Awaitable[list[Any]]],
        arguments: list[Argument],
        results: list[Argument],
    ) -> Callable[..., Awaitable[Any]]:
        """Return a method for asyncua that checks its arguments and calls `call` with their values.

        The method raises nothing. It returns the results as variants; for wrong arguments and for
        an error of `call` it returns a status code, and writes a line that says why to LastRefused.
        """
        listed = ", ".join(
            f"{argument.name} ({argument.type.name}{' array' if argument.is_array else ''})"
            for argument in arguments
        )

        @wraps(call)
        async def method(parent: ua.NodeId, *variants: ua.Variant) -> Any:
            """Check the arguments, call, and return the results or a status code."""
            code, detail = _argument_error(variants, arguments)
            line = f"Expected {listed}{detail}."
            if code is None:
                try:
                    values = await call(*map(_argument_value, variants, arguments))
                    return [
                        ua.Variant(value, result.type)
                        for value, result in zip(values, results, strict=True)
                    ]
                except DengineError as error:
                    code = StatusCodes.BadInvalidArgument
                    line = as_options(str(error))
                except Exception:
                    log.exception("a call over OPC UA failed")
                    code = StatusCodes.BadInternalError
                    line = "The server failed on this call."
            text = ua.Variant(one_line(line), VariantType.String)
            await self._nodes["LastRefused"].write_value(ua.DataValue(text))
            return _status_code(code)

        return method

    def _node_id(self, text: str) -> ua.NodeId:
        return ua.NodeId(ua.String(text), ua.Int16(self._index))

    def _browse_name(self, text: str) -> ua.QualifiedName:
        return ua.QualifiedName(text, self._index)


def _argument_error(
    variants: tuple[ua.Variant, ...], arguments: list[Argument]
) -> tuple[int | None, str]:
    """Return a status code and a text for wrong arguments of a call; None and "" for right ones.

    Number, types and arrays are checked; only a text may be null.
    """
    n = len(variants)
    if n < len(arguments):
        return StatusCodes.BadArgumentsMissing, f", got {n} of {len(arguments)} arguments"
    if n > len(arguments):
        return StatusCodes.BadTooManyArguments, f", got {n} arguments"
    for variant, argument in zip(variants, arguments, strict=True):
        is_null = variant.Value is None
        is_list = isinstance(variant.Value, list)
        # Controllers send an empty text as null.
        may_be_null = variant.VariantType in (VariantType.String, VariantType.Null)
        if is_null and argument.type is VariantType.String and may_be_null:
            continue
        if is_null or variant.VariantType is not argument.type or is_list is not argument.is_array:
            form = "null" if is_null else f"{variant.VariantType.name}{' array' * is_list}"
            return StatusCodes.BadInvalidArgument, f", got {argument.name} as {form}"
    return None, ""


def _argument_value(variant: ua.Variant, argument: Argument) -> Any:
    """Return an argument's value; a null String is an empty one."""
    if variant.Value is None and argument.type is VariantType.String:
        return ""
    return variant.Value


def _status_code(code: int) -> ua.StatusCode:
    return ua.StatusCode(ua.UInt32(code))


def _as_ua_argument(argument: Argument) -> ua.Argument:
    """Return an argument with its type, array rank and description, as clients see it."""
    rank = ua.ValueRank.OneDimension if argument.is_array else ua.ValueRank.Scalar
    dimensions = [0] if argument.is_array else []
    return ua.Argument(
        argument.name,
        ua.NodeId(ua.Int32(argument.type.value)),
        rank,
        dimensions,
        ua.LocalizedText(argument.description),
    )
