"""What asyncua's server lacks against malformed and endless messages.

A length that is negative, or greater than what follows it, is refused: in twenty bytes, two thousand million nulls could be
asked for. Messages are bounded while they arrive and not after; what cannot be read ends its connection; nobody is an
administrator.
"""

from __future__ import annotations

import functools
import hmac
import logging
from collections.abc import Callable
from typing import Any

from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_server import InternalServer
from asyncua.server.server import Server
from asyncua.ua import ua_binary
from asyncua.ua.status_codes import StatusCodes
from asyncua.ua.uaerrors import UaError

log = logging.getLogger("dengine")
MOST = 1 << 20  # bytes of a message: 250,000 samples
CHUNK = 65535  # bytes of a message's part
CONNECTIONS = 50
SUBSCRIPTIONS = 100
GREETING = 10.0  # seconds in which a connection must have become a session
USER = "dengine"

Reader = Callable[[Any], Any]


def bounded(make: Callable[[Any], Reader]) -> Callable[[Any], Reader]:
    """A maker of readers of arrays, whose readers refuse an array of more elements than there are bytes left."""

    @functools.cache
    def maker(kind: Any) -> Reader:
        read = make(kind)

        def checked(data: Any) -> Any:
            if isinstance(data, Buffer) and (n := int.from_bytes(data.copy(4).read(4), "little", signed=True)) > len(data):
                raise UaError(f"an array of {n} elements in {len(data)} bytes")
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
            raise UaError(f"a length of {size}")
        return bytes(lenient(self, size))

    Buffer.read = read  # type: ignore[method-assign]
    for name in ("_create_uatype_array_deserializer", "_create_list_deserializer"):
        setattr(ua_binary, name, bounded(getattr(ua_binary, name)))
    for cached in (ua_binary._create_type_deserializer, ua_binary._create_dataclass_deserializer):
        cached.cache_clear()


class BoundedProtocol(OPCUAProtocol):
    """A connection that ends at the first thing that is no message of a bearable size."""

    def data_received(self, data: bytes) -> None:
        """Take in what came; the connection ends where too much of one message is announced or waiting."""
        super().data_received(data)
        if len(self._buffer) > MOST or int.from_bytes(self._buffer[4:8], "little") > MOST:
            log.warning("an OPC UA message is too long; the connection is closed")
            self._end(StatusCodes.BadTcpMessageTooLarge)

    def _end(self, code: int) -> None:
        """Say why, and hang up."""
        self._buffer = b""
        if self.transport is not None and not self.transport.is_closing():
            said = ua.ErrorMessage(ua.StatusCode(ua.UInt32(code)), ua.String("refused"))
            kind: Any = ua.MessageType.Error  # bytes, which their types call something else
            self.transport.write(ua_binary.uatcp_to_binary(kind, said))
            self.transport.close()

    async def _process_one_msg(self, header: Any, buf: Any) -> bool:
        try:
            return await super()._process_one_msg(header, buf)
        except Exception as error:  # whatever a malformed message does to its readers, it is malformed
            log.info("an OPC UA message could not be read (%s); the connection is closed", type(error).__name__)
            self._end(StatusCodes.BadDecodingError)
            return False


class BoundedListener(BinaryServer):
    """Accepts connections whose messages are bounded."""

    def _make_protocol(self) -> OPCUAProtocol:
        return BoundedProtocol(self.iserver, self._policies, self.clients, self.closing_tasks, self.limits)


class Users:
    """Who may read and call: everybody on this machine, or who knows the token. Nobody may change the address space."""

    def __init__(self, token: str | None) -> None:
        self._token = token

    def get_user(
        self, iserver: InternalServer, username: str | None = None, password: Any = None, certificate: Any = None
    ) -> User | None:
        """The user of this name and password; None where there is none."""
        if self._token is None:
            return User(role=UserRole.User, name="anyone")
        given = password if isinstance(password, bytes) else str(password or "").encode("utf-8", "surrogateescape")
        same = hmac.compare_digest(given, self._token.encode())
        return User(role=UserRole.User, name=USER) if same and username == USER else None


class BoundedServer(Server):
    """asyncua's server with these limits. token : the password of the one user; None: anyone on this machine may ask."""

    def __init__(self, token: str | None = None) -> None:
        harden()
        super().__init__(user_manager=Users(token))  # type: ignore[arg-type]  # a duck of theirs, as their own ones are
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
