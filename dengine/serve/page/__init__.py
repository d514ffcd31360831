"""The live page: what the cell does now, how it is doing, the map of its parts, its history, and what people may do.

    app = create_app(service, interfaces=("page",))

Rendered here, with nothing from outside: templates, one stylesheet and one script are part of the package.
"""

from .routes import routes

__all__ = ["routes"]
