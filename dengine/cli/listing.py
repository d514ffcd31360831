"""Options that take several values, with commas between."""

from __future__ import annotations

from typing import Any

import click


class Listed(click.ParamType[Any]):
    """Values with commas between, as a tuple; each is what another type says."""

    name = "list"

    def __init__(self, of: click.ParamType[Any]) -> None:
        self.of = of

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[Any, ...]:
        """'0.5,0.1' -> (0.5, 0.1); a wrong one among them is a usage error."""
        if isinstance(value, tuple):
            return value
        parts = [part.strip() for part in str(value).split(",") if part.strip()]
        if not parts:
            self.fail("expected at least one value, with commas between.", param, ctx)
        return tuple(self.of.convert(part, param, ctx) for part in parts)
