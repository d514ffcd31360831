"""The web application in front of one engine: the interfaces' routes behind one guard.

    app = create_app(CellService(lambda: DataEngine.open_or_create("cell.db"), "cell.db"))

Each interface is a module of this package that gives its routes; `INTERFACES` names them.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.routing import BaseRoute

from ..errors import SettingError
from ..wording import shortened
from . import http, page, xmlrpc
from .access import Access
from .calls import Recorder
from .guard import Guard
from .problems import HANDLERS
from .service import CellService

INTERFACES: Mapping[str, Callable[[CellService, Recorder | None], Sequence[BaseRoute]]] = {
    "http": lambda service, recorder: http.routes(service),
    "xmlrpc": xmlrpc.routes,
    "page": lambda service, recorder: page.routes(service),
}
Beside = Callable[[CellService], AbstractAsyncContextManager[object]]


def create_app(
    service: CellService,
    access: Access | None = None,
    interfaces: Sequence[str] = tuple(INTERFACES),
    beside: Sequence[Beside] = (),
    recorder: Recorder | None = None,
) -> Starlette:
    """The application; whoever made the service closes it, once the application has ended.

    access : who may ask, and how much; None: whoever is on this machine.
    interfaces : those that answer, of `INTERFACES`; their routes are tried in this order.
    beside : what runs in the same loop as long as the application does, an OPC UA server for one.
    recorder : of what a robot's program asks to decide on by `decide_recorded`; whoever made it closes it.
    SettingError for an interface that there is not.
    """
    if unknown := [name for name in interfaces if name not in INTERFACES]:
        raise SettingError(f"Expected interfaces among {', '.join(INTERFACES)}, got {shortened(unknown[0])}.")
    routes = [route for name in interfaces for route in INTERFACES[name](service, recorder)]

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
