"""`opcua_server` serves a cell over OPC UA: methods for a PLC to call, and variables for a SCADA
system to read. `dengine serve --opcua` starts it.

    async with opcua_server(service, port=4840):
        ...

The namespace `urn:dengine:cell` has one object, Cell, with the methods Decide and Report and
read-only variables. The file cell.xml, an OPC UA NodeSet, describes them; a PLC's engineering tool
can import it. The text NodeIds do not change between versions. The variables follow the store, at
most twice a second. The begin and the end of an alarm are events of the Server object.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
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
from asyncua.ua.status_codes import StatusCodes

from ..errors import DengineError, SettingError, TraceError, as_options, log
from .auth import Tokens, check_key_pair, find_token, host_in_url, is_loopback
from .robot_calls import RobotCalls, one_line
from .service import CellService

MAX_MESSAGE = 1 << 20  # bytes, 250,000 samples
CHUNK = 65535  # bytes of a part of a message
MAX_CONNECTIONS = 50
MAX_SUBSCRIPTIONS = 100
USER = "dengine"
NAMESPACE = "urn:dengine:cell"
MIN_REFRESH = 0.5  # seconds between two readings of the store
MAX_REFRESH = 5.0
ALARM = 700  # severity, of 1 to 1000
ALARM_ENDED = 100
# Each variable with the status but LastRefused, and the status's name in `RobotCalls.status`.
STATUS_NAMES = {
    "Decisions": "decisions",
    "VerifiedShare": "verified_share",
    "Accepted": "accepted",
    "Rejected": "rejected",
    "Bad": "bad",
    "ModelVersion": "version",
    "SafeMode": "safe_mode",
    "SafeModeReason": "safe_mode",
    "Shadow": "shadow",
    "Alarm": "alarm",
    "AlarmText": "alarm",
    "Waiting": "waiting",
    "Late": "late",
    "Busy": "busy",
}


class TokenUsers(UserManager):
    """Who may read and call: the user `dengine` with a token as the password. Nobody administers.

    A viewer's token is no password: whoever may read over OPC UA may also call.

    Parameters
    ----------
    tokens : tuple of Token
        Empty: everybody.
    encrypted : bool
        Whether clients without a certificate are refused; every client that encrypts has one.
        asyncua lets anyone open a channel without security, to ask for the endpoints, and would
        accept a session on it.
    """

    def __init__(self, tokens: Tokens, encrypted: bool) -> None:
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

        A session is refused if the server encrypts and the client has no certificate. If the server
        has access tokens, a session is also refused unless the user name is `dengine` and the
        password is one of the tokens that permit more than reading; without tokens everybody gets a
        user. `iserver` is not used, and the content of the certificate is not checked.
        """
        if self._encrypted and not certificate:
            return None
        if not self._tokens:
            return User(role=UserRole.User, name="anyone")
        token = find_token(self._tokens, password or "")
        if token is not None and token.operates and username == USER:
            return User(role=UserRole.User, name=USER)
        return None


@asynccontextmanager
async def opcua_server(
    service: CellService,
    port: int,
    host: str = "127.0.0.1",
    tokens: Tokens = (),
    cert: Path | None = None,
    key: Path | None = None,
) -> AsyncIterator[Server]:
    """Serve a robot cell over OPC UA in this event loop, as long as the context lasts.

    The logger of asyncua is set to CRITICAL, and stays so.

    Parameters
    ----------
    service : CellService
        The engine that is served, with its queue of requests.
    port : int
        0: any free port; `server.bserver.port` of the yielded server then says which.
    host : str
    tokens : tuple of Token, optional
        Access tokens. Those of operators (who may do more than read) are passwords of the user
        `dengine`; a viewer's token gives no access. Empty: everybody may read and call.
    cert, key : path, optional
        Files in PEM. With them the server speaks only Basic256Sha256, signed and encrypted; without
        them it encrypts nothing.

    Yields
    ------
    Server
        The server, which listens. Its variables have the cell's present status, like counts and
        alarms, if that could be read.

    Raises
    ------
    SettingError
        For an address that other machines can reach, unless there are an operator's token, a
        certificate and a key. Also if only one of `cert` and `key` is given, or they cannot be
        used.
    OSError
        If the server cannot listen at this address, for example because the port is in use.
    """
    has_password = any(token.operates for token in tokens)
    if not (is_loopback(host) or (cert is not None and has_password)):
        raise SettingError(
            f"Expected a token, a certificate and a key to serve OPC UA on {host}; or stay on "
            "127.0.0.1."
        )
    check_key_pair(cert, key)
    # asyncua logs tracebacks of whatever strangers send.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    server = Server(user_manager=TokenUsers(tokens, cert is not None))
    server.limits.max_message_size = MAX_MESSAGE
    server.limits.max_chunk_count = MAX_MESSAGE // CHUNK + 1
    server.iserver.max_connections = MAX_CONNECTIONS
    server.iserver.max_subscriptions = MAX_SUBSCRIPTIONS
    identity = ua.UserNameIdentityToken if tokens else ua.AnonymousIdentityToken
    server.set_identity_tokens([identity])
    await server.init()
    server.allow_remote_admin(False)
    server.set_endpoint(f"opc.tcp://{host_in_url(host)}:{port}/dengine")
    server.set_server_name("dengine")
    await server.set_application_uri("urn:dengine:server")
    policy = ua.SecurityPolicyType.NoSecurity
    if cert is not None and key is not None:
        policy = ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt
        await server.load_certificate(cert, "pem")
        await server.load_private_key(key, format="pem")
    server.set_security_policy([policy])
    space = AddressSpace(server, service)
    await space.build()
    async with server:
        await space.refresh()
        following = asyncio.create_task(space.follow_changes())
        try:
            yield server
        finally:
            following.cancel()
            await asyncio.wait([following])


class AddressSpace:
    """The nodes of one robot cell in an OPC UA server: its variables, methods and alarm events.

    `opcua_server` makes it, and calls `build` and then `refresh`, all in the server's event loop.
    Its methods have no recorder, and of the methods of `RobotCalls` only `decide` and `report`.

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
        self._alarm = ""

    async def build(self) -> None:
        """Create the nodes of the file cell.xml in the server: the cell's variables and methods.

        It also links the OPC UA methods Decide and Report to `decide` and `report`, and makes the
        object that sends alarm events. Call it once, before the server starts.
        """
        await self._server.import_xml(str(Path(__file__).with_name("cell.xml")))
        self._namespace = await self._server.get_namespace_index(NAMESPACE)
        await self._node("LastRefused").write_value("")  # the file's empty text is read as null
        for name, call in (("Decide", self.decide), ("Report", self.report)):
            node = self._node(name)
            arguments, results = [
                await (await node.get_child(f"0:{kind}Arguments")).read_value()
                for kind in ("Input", "Output")
            ]
            self._server.link_method(node, self._as_method(call, arguments, results))
        self._events: EventGenerator = await self._server.get_event_generator()
        cell = self._server.get_node(f"ns={self._namespace};s=Cell")
        self._events.event.SourceNode = cell.nodeid
        self._events.event.SourceName = "Cell"

    def _node(self, name: str) -> Node:
        """Return the node of a variable or a method of the robot cell, whose NodeId is "Cell.NAME".

        Whether the server has such a node is not checked. `build` must have been called.
        """
        return self._server.get_node(f"ns={self._namespace};s=Cell.{name}")

    async def decide(self, trace: list[float], channels: int, request: str, part: str) -> list[Any]:
        """Decide on a flat trace: all samples of the first channel, then those of the next.

        Returns a list: the action (0 verify, that is, check the part; 1 accept; 2 reject), the id,
        the reason, the lower and upper bound of the success probability, and the version of the
        model. `request` is the caller's id of the trace, "" for a new id; `part` is the part's
        number, "" for none. If an id comes again with the same trace, its decision is returned
        again.

        If a request waits in the queue for longer than the service's deadline, a new decision is
        VERIFY with the reason "late" or a fault of the trace, and if the store fails with the
        reason "no_store"; such a decision may be missing from the store. If the queue is full, or
        the service or its engine is closed, nothing is recorded, and the result is VERIFY with an
        empty id, the reason "busy", the bounds 0 and 1, and version 0.

        Raises TraceError if the trace is empty, if `channels` is below 1 or the trace's length no
        multiple of it, for a trace whose shape or values the engine refuses, for an invalid part
        number, and for an id that belongs to another trace. Raises ReportError for an invalid id,
        and SettingError if the engine's first trace does not fit its settings.
        """
        if channels < 1 or len(trace) % channels or not trace:
            raise TraceError(
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
        ReportError for an invalid id, and for a report that contradicts an earlier one, unless it
        is a line stop after a confirmation.
        """
        return [await self._calls.report(decision_id, success)]

    async def follow_changes(self) -> None:
        """Refresh the variables at once, after each change, and after `MAX_REFRESH` seconds without
        one.

        After each refresh it waits `MIN_REFRESH` seconds before the next one. It ends when the
        service's `end_listening` is called.
        """
        async for _ in self._service.changes(MAX_REFRESH):
            await self.refresh()
            await asyncio.sleep(MIN_REFRESH)  # meanwhile the newest decisions reach the store

    async def refresh(self) -> None:
        """Read the cell's status and write it into the OPC UA variables.

        The status has counts of decisions, the alarm, the safe mode (parts are checked until new
        outcomes allow decisions again) and the like. An OPC UA event is sent if the text of the
        alarm has changed (`write_status`). If the status cannot be read or written, or the event
        cannot be sent, a warning is logged and no error is raised. All variables of the status then
        get the OPC UA status code UncertainLastUsableValue, which marks them as old; those written
        before the error keep the new values, the others their old ones. The variable LastRefused
        (why the last call was refused) is not part of the status, and stays as it is. An error
        while the variables are marked is raised.
        """
        try:
            await self.write_status(await self._calls.status())
        except Exception as error:  # the store is unavailable, or the queue full
            log.warning("the OPC UA variables could not be brought up to date: %s", error)
            status = _status_code(StatusCodes.UncertainLastUsableValue)
            for name in STATUS_NAMES:
                node = self._node(name)
                old = await node.read_data_value(raise_on_bad_status=False)
                await node.write_value(ua.DataValue(old.Value, status))

    async def write_status(self, status: Mapping[str, Any]) -> None:
        """Write a status, as `RobotCalls.status` returns it, into the OPC UA variables.

        `STATUS_NAMES` maps each variable to its key in the status. If the text of the alarm differs
        from that of the last call (before the first call: ""), an OPC UA event with the new text is
        sent, of severity 700. If the new text is empty, the event says that the old alarm has
        ended, with severity 100. Raises KeyError if the status lacks one of the keys; variables
        before it are written.
        """
        for name, key in STATUS_NAMES.items():
            node = self._node(name)
            type_ = await node.read_data_type_as_variant_type()
            value = bool(status[key]) if type_ is VariantType.Boolean else status[key]
            await node.write_value(value, type_)
        alarm = status["alarm"]
        if alarm != self._alarm:
            self._events.event.Severity = ALARM if alarm else ALARM_ENDED
            await self._events.trigger(message=alarm or f"Over: {self._alarm}")
            self._alarm = alarm

    def _as_method(
        self,
        call: Callable[..., Awaitable[list[Any]]],
        arguments: list[ua.Argument],
        results: list[ua.Argument],
    ) -> Callable[..., Awaitable[Any]]:
        """Return a method for asyncua that checks its arguments and calls `call` with their values.

        `arguments` and `results` are the OPC UA descriptions of the arguments and results of
        `call`. The method returns the results as OPC UA variants, and passes a null argument on as
        the text "". For a wrong number or type of arguments, or if `call` raises, it raises
        nothing, but returns a bad status code, and writes the reason into the OPC UA variable
        LastRefused. An error of `call` that is not dengine's own is also logged.
        """
        forms = [_form(_type_of(item), item.ValueRank > 0) for item in arguments]
        names = [item.Name for item in arguments]
        expected = ", ".join(map("{} ({})".format, names, forms))
        types = [_type_of(item) for item in results]

        async def method(parent: ua.NodeId, *variants: ua.Variant) -> Any:
            """Check the arguments, call, and return the results; for an error write its text into
            LastRefused, and return a bad status code: BadInternalError for an unexpected error,
            BadInvalidArgument for any other. `parent` is not used.
            """
            # Controllers send an empty text as null.
            texts = [ua.Variant("") if item.Value is None else item for item in variants]
            given = [_form(item.VariantType, isinstance(item.Value, list)) for item in texts]
            code = StatusCodes.BadInvalidArgument
            line = f"Expected {expected}, got {', '.join(given) or 'none'}."
            if given == forms:
                try:
                    values = await call(*(item.Value for item in texts))
                    return list(map(ua.Variant, values, types))
                except DengineError as error:
                    line = as_options(str(error))
                except Exception:
                    log.exception("a call over OPC UA failed")
                    code = StatusCodes.BadInternalError
                    line = "The server failed on this call."
            await self._node("LastRefused").write_value(one_line(line), VariantType.String)
            return _status_code(code)

        return method


def _type_of(argument: ua.Argument) -> VariantType:
    return VariantType(argument.DataType.Identifier)


def _form(variant_type: VariantType, is_array: bool) -> str:
    """Return the name of an argument's type for messages: "Float array" if `is_array`, else
    "Float". Two arguments have the same type if these names are equal.
    """
    return f"{variant_type.name}{' array' * is_array}"


def _status_code(code: int) -> ua.StatusCode:
    return ua.StatusCode(ua.UInt32(code))
