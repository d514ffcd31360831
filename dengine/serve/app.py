"""The web application in front of one engine: the interfaces' routes behind one guard.

    app = create_app(CellService(lambda: DataEngine.open_or_create("cell.db"), "cell.db"))

Each interface is a module of this package with `routes(service)`; `INTERFACES` names them.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.routing import BaseRoute

from .access import Access
from .calls import Recorder
from .guard import Guard
from .problems import HANDLERS
from .service import CellService

INTERFACES = ("http", "xmlrpc", "page")  # modules here, in the order in which their routes are tried
Beside = Callable[[CellService], AbstractAsyncContextManager[object]]


def create_app(
    service: CellService,
    access: Access | None = None,
    interfaces: Sequence[str] = INTERFACES,
    beside: Sequence[Beside] = (),
    recorder: Recorder | None = None,
) -> Starlette:
    """The application; whoever made the service closes it, once the application has ended.

    access : who may ask, and how much; None: whoever is on this machine.
    interfaces : modules of this package that answer.
    beside : what runs in the same loop as long as the application does, an OPC UA server for one.
    recorder : of what a robot's program asks to decide on by `decide_recorded`; whoever made it closes it.
    """
    given: dict[str, dict[str, Any]] = {"xmlrpc": {"recorder": recorder}}
    routes: list[BaseRoute] = [route for name in interfaces for route in routes_of(name, service, given.get(name, {}))]

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        async with AsyncExitStack() as stack:
            try:
                for begin in beside:
                    await stack.enter_async_context(begin(service))
            except Exception as error:
                app.state.failure = error  # uvicorn says only that it did not start
                raise
            yield

    guard = Middleware(Guard, access=access or Access())
    app = Starlette(routes=routes, middleware=[guard], exception_handlers=HANDLERS, lifespan=lifespan)
    app.router.redirect_slashes = False  # a robot does not follow; and where to, a request's Host would say
    return app


def routes_of(name: str, service: CellService, given: Mapping[str, Any]) -> Sequence[BaseRoute]:
    """The routes of one interface, given what it wants beside the service."""
    module = f"{__package__}.{name}"
    found: Sequence[BaseRoute] = import_module(module).routes(service, **given) if find_spec(module) else ()
    return found
