"""What asyncua's server lacks against malformed and endless messages.

A length that is negative, or greater than what follows it, is refused: in twenty bytes, two thousand million nulls could be
asked for. Messages are bounded while they arrive and not after; what cannot be read ends its connection; nobody is an
administrator. Before a connection is ended, an ERR message (OPC UA Part 6, 7.1.2.5) says why, by a status code and what the
standard says of that code; only a CloseSecureChannel has no answer, for the protocol has none.
"""

from __future__ import annotations

import asyncio
import functools
import hmac
import logging
import struct
from collections.abc import Callable
from typing import Any

from asyncua import ua
from asyncua.common.utils import Buffer, ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_server import InternalServer
from asyncua.server.server import Server
from asyncua.ua import ua_binary
from asyncua.ua.status_codes import StatusCodes, get_name_and_doc
from asyncua.ua.uaerrors import BadDecodingError, UaError, UaStatusCodeError
from cryptography.exceptions import InvalidSignature

log = logging.getLogger("dengine")
MOST = 1 << 20  # bytes of a message: 250,000 samples
CHUNK = 65535  # bytes of a message's part
CONNECTIONS = 50
SUBSCRIPTIONS = 100
GREETING = 10.0  # seconds in which a connection must have become a session, and half a message a whole one
BUFFER = 1024  # bytes that a client must be able to take at once: the least that any OPC UA lets it have
USER = "dengine"
HEADS = {b"HELF": 8, b"OPNF": 12, b"CLOF": 12, b"MSGF": 12, b"MSGC": 12, b"MSGA": 12}  # what a client sends; a head's bytes

Reader = Callable[[Any], Any]


def bounded(make: Callable[[Any], Reader]) -> Callable[[Any], Reader]:
    """A maker of readers of arrays, whose readers refuse an array of more elements than there are bytes left."""

    @functools.cache
    def maker(kind: Any) -> Reader:
        read = make(kind)

        def checked(data: Any) -> Any:
            if isinstance(data, Buffer) and int.from_bytes(data.copy(4).read(4), "little", signed=True) > len(data):
                raise BadDecodingError  # more elements than bytes
            return read(data)

        return checked

    return maker


def harden() -> None:
    """Make asyncua's readers strict, in this process, once."""
    if hasattr(Buffer, "lenient_read"):
        return
    lenient = Buffer.lenient_read = Buffer.read  # type: ignore[attr-defined]

    def read(self: Buffer, size: int) -> bytes:
        if size < 0:  # it would go back, and read the same again
            raise BadDecodingError
        return bytes(lenient(self, size))

    Buffer.read = read  # type: ignore[method-assign]
    for name in ("_create_uatype_array_deserializer", "_create_list_deserializer"):
        setattr(ua_binary, name, bounded(getattr(ua_binary, name)))
    for cached in (ua_binary._create_type_deserializer, ua_binary._create_dataclass_deserializer):
        cached.cache_clear()


class BoundedProtocol(OPCUAProtocol):
    """A connection that ends, and says why, at the first thing that is no message of a bearable size, or half of one."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._came = bytearray()  # of a message that is not whole yet
        self._half: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Take a connection, or say that there are too many."""
        if len(self.clients) >= self.iserver.max_connections:
            transport.write(error_message(StatusCodes.BadTcpNotEnoughResources))
        super().connection_made(transport)

    def connection_lost(self, ex: BaseException | None) -> None:
        """Let go."""
        self._stop_waiting()
        super().connection_lost(ex)

    def data_received(self, data: bytes) -> None:
        """Hand on what is whole; what cannot become a message ends the connection."""
        self._came += data
        while self._came and not self._is_closing():
            code, size = beginning(bytes(self._came[:8]))
            if code or self.messages.full():
                self._end(code or StatusCodes.BadTcpNotEnoughResources)
            elif len(self._came) < size:
                self._wait()
                return
            else:
                self._hand_on(size)

    def _hand_on(self, size: int) -> None:
        message = bytes(self._came[:size])
        del self._came[:size]
        self._stop_waiting()
        super().data_received(message)
        if message.startswith(b"MSGC"):  # a part, that others have to follow
            self._wait()

    def _wait(self) -> None:
        """Let the rest of a message come, for a while."""
        if self._half is None:
            self._half = asyncio.get_running_loop().call_later(GREETING, self._end, StatusCodes.BadTimeout)

    def _is_closing(self) -> bool:
        return self.transport is None or self.transport.is_closing()

    def _stop_waiting(self) -> None:
        if self._half is not None:
            self._half.cancel()
            self._half = None

    def _end(self, code: int) -> None:
        """Say why, and hang up."""
        if self.transport is not None and not self.transport.is_closing():
            log.info("an OPC UA connection is ended: %s", get_name_and_doc(code)[0])
            self.transport.write(error_message(code))
            self.transport.close()

    async def _activation_watchdog(self) -> None:
        await asyncio.sleep(self.iserver.max_pending_activation_seconds)
        session = None if self.processor is None else self.processor.session
        if session is None or not session.is_activated():
            self._end(StatusCodes.BadTimeout)

    async def _process_one_msg(self, header: Any, buf: Any) -> bool:
        try:
            self._must_fit(header, buf)
            return await super()._process_one_msg(header, buf)
        except Exception as error:  # whatever a malformed message does to its readers, it is malformed
            log.info("an OPC UA message could not be read: %s", type(error).__name__)
            self._end(code_of(error))
            return False

    def _must_fit(self, header: Any, buf: Any) -> None:
        """What asyncua takes though it could not answer it, or before there is a channel that is as secure as was asked."""
        if header.MessageType == ua.MessageType.Hello and min(struct.unpack("<II", buf.copy(12).read(12)[4:])) < BUFFER:
            raise ServiceError(StatusCodes.BadInvalidArgument)
        channel: Any = None if self.processor is None else self.processor._connection
        secured = header.MessageType in (ua.MessageType.SecureMessage, ua.MessageType.SecureClose)
        if secured and not (channel.is_open() and header.ChannelId == channel.security_token.ChannelId):
            raise ServiceError(StatusCodes.BadTcpSecureChannelUnknown)


def beginning(head: bytes) -> tuple[int, int]:
    """A message by its first eight bytes, or by fewer: the status code that refuses it, or 0, and how long it is."""
    kind, size = head[:4], int.from_bytes(head[4:], "little")
    if not any(each.startswith(kind) for each in HEADS):
        return StatusCodes.BadTcpMessageTypeInvalid, 0
    if len(head) < 8:
        return 0, 8
    if size > CHUNK:
        return StatusCodes.BadTcpMessageTooLarge, 0
    return (0, size) if size > HEADS[kind] else (StatusCodes.BadDecodingError, 0)


def code_of(error: Exception) -> int:
    """The status code of what asyncua raises at a message."""
    if isinstance(error, ServiceError | UaStatusCodeError):
        return int(error.code)
    # A UaError of no kind is said of a channel, a token, a sequence or a policy that is not as it was agreed on.
    insecure = isinstance(error, InvalidSignature) or type(error) is UaError
    return StatusCodes.BadSecurityChecksFailed if insecure else StatusCodes.BadDecodingError


def error_message(code: int) -> bytes:
    """An ERR message: the code, and what the standard says of it."""
    said = ua.ErrorMessage(ua.StatusCode(ua.UInt32(code)), ua.String(get_name_and_doc(code)[1]))
    kind: Any = ua.MessageType.Error  # bytes, which their types call something else
    return ua_binary.uatcp_to_binary(kind, said)


class BoundedListener(BinaryServer):
    """Accepts connections whose messages are bounded."""

    def _make_protocol(self) -> OPCUAProtocol:
        return BoundedProtocol(self.iserver, self._policies, self.clients, self.closing_tasks, self.limits)


class Users:
    """Who may read and call: everybody on this machine, or who knows the token. Nobody may change the address space.

    encrypted : only who shows a certificate, as whoever encrypts does: asyncua lets anyone open a channel without security,
    so that a client can ask what the endpoints are, and would let a session begin on it.
    """

    def __init__(self, token: str | None, encrypted: bool = False) -> None:
        self._token, self._encrypted = token, encrypted

    def get_user(
        self, iserver: InternalServer, username: str | None = None, password: Any = None, certificate: Any = None
    ) -> User | None:
        """The user of this name and password; None where there is none."""
        if self._encrypted and not certificate:
            return None
        if self._token is None:
            return User(role=UserRole.User, name="anyone")
        given = password if isinstance(password, bytes) else str(password or "").encode("utf-8", "surrogateescape")
        same = hmac.compare_digest(given, self._token.encode())
        return User(role=UserRole.User, name=USER) if same and username == USER else None


class BoundedServer(Server):
    """asyncua's server with these limits.

    token : the password of the one user; None: anyone on this machine may ask.  encrypted : no session without encryption.
    """

    def __init__(self, token: str | None = None, encrypted: bool = False) -> None:
        harden()
        super().__init__(user_manager=Users(token, encrypted))  # type: ignore[arg-type]  # a duck of theirs, as their own ones are
        self.set_identity_tokens([ua.AnonymousIdentityToken if token is None else ua.UserNameIdentityToken])
        self.limits.max_message_size, self.limits.max_chunk_count = MOST, MOST // CHUNK + 1
        self.iserver.allow_remote_admin = False
        self.iserver.max_pending_activation_seconds = GREETING
        self.iserver.max_connections, self.iserver.max_subscriptions = CONNECTIONS, SUBSCRIPTIONS

    @property
    def port(self) -> int:
        """Where it listens, once it does."""
        return 0 if self.bserver is None else self.bserver.port

    async def start(self) -> None:
        """Listen. OSError where the port is taken."""
        await self._setup_server_nodes()
        await self.iserver.start()
        host, port = self._get_bind_socket_info()
        self.bserver = BoundedListener(self.iserver, host or "127.0.0.1", port or 0, self.limits)
        self.bserver.set_policies(self._policies)
        try:
            await self.bserver.start()
        except OSError:
            await self.iserver.stop()
            raise
