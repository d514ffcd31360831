"""The live page, rendered here with nothing from outside: `create_app(service, interfaces=("page",))`."""

from .routes import environment, routes

__all__ = ["environment", "routes"]
