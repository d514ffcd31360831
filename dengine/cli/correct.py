"""`dengine correct`, `forget`, `rollback`, `policy`, `retrain`: what people put right in a store, and train by hand."""

from __future__ import annotations

import getpass
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import click

from . import options
from .options import POLICY, Known
from .output import certificate_record, facts, show, write_json

if TYPE_CHECKING:
    from ..engine.corrections import Changed
    from ..engine.engine import DataEngine

Command = Callable[..., Any]
LABELS = {"good": True, "bad": False}


def _login() -> str:
    """The login name; "" where the system has none for this user."""
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # in a container a number may have no name
        return ""


def corrects(example: str) -> Callable[[Command], click.Command]:
    """A verb on STORE and a cell of it, with `--author` and `--json`; what else it takes comes below."""

    def decorate(command: Command) -> click.Command:
        whose = options.cell_options()(author_option(options.json_option(command)))
        return click.command(epilog=options.example(example))(options.store_argument(whose))

    return decorate


shadow_option = click.option(
    "--shadow",
    type=click.Choice(["on", "off"]),
    callback=lambda context, option, state: None if state is None else state == "on",
    help="Verify every part, and let the model only say what it would have done; or let it decide again.",
)
interval_option = click.option("--interval", type=Known("interval"), help="The confidence interval.")
author_option = click.option("--author", default=_login, help="Who says so, for the record.  [default: the login name]")


def _changed(verb: str, store: str, author: str, change: Callable[[DataEngine], Changed], as_json: bool) -> None:
    """Open the store's engine, change something, and say what happened."""
    from ..engine.engine import DataEngine
    from ..store.base import UNHURRIED

    with DataEngine.open(store, wait=UNHURRIED) as engine:
        changed = change(engine)
        certificate, policy = engine.certificate(), engine.policy
    if as_json:
        about = {"verb": verb, "store": store, "author": author, "changed": changed.event is not None}
        write_json(about | asdict(changed) | {"policy": policy, "certificate": certificate_record(certificate)})
        return
    recorded = "" if changed.event is None else f" Event {changed.event}, by {author or 'nobody named'}."
    show(f"{changed.text}{recorded}")


@corrects("dengine correct engine.db import-d684ff7e4dbab839-0 bad")
@click.argument("decision", metavar="ID")
@click.argument("label", metavar="good|bad", type=click.Choice(list(LABELS)))
def correct(store: str, decision: str, label: str, author: str, as_json: bool) -> None:
    """Say that a label was wrong: the part was good, or bad.

    From now on the decision ID counts so. The label as it was reported stays in the store, and so does what was
    decided; the correction is a later row. A forgotten label counts again by it.
    """
    _changed("correct", store, author, lambda engine: engine.correct(decision, LABELS[label], author), as_json)


@corrects("dengine forget engine.db import-ad72a2e9751fbf6f-0 --reason 'the fixture was bent'")
@click.argument("decisions", metavar="ID...", nargs=-1, required=True)
@click.option("--reason", default="", help="Why, for the record.")
def forget(store: str, decisions: tuple[str, ...], reason: str, author: str, as_json: bool) -> None:
    """Leave labels out of all that is learned and counted.

    Nothing is deleted: traces and labels stay in the store, and `dengine correct` brings one back. All are forgotten, or,
    where one is unknown or has no label, none.
    """
    _changed("forget", store, author, lambda engine: engine.forget(*decisions, author=author, reason=reason), as_json)


@corrects("dengine rollback engine.db 1")
@click.argument("version", metavar="VERSION", type=int)
def rollback(store: str, version: int, author: str, as_json: bool) -> None:
    """Let an earlier model version answer again, as a new one.

    Labels that came since are among its references, and corrections count.
    """
    _changed("rollback", store, author, lambda engine: engine.rollback(version, author), as_json)


@corrects("dengine policy engine.db --alpha 0.05 --lower-bound 0.95")
@options.gathered("settings", options.given, POLICY | {"interval": interval_option, "shadow": shadow_option})
def policy(store: str, settings: dict[str, Any], author: str, as_json: bool) -> None:
    """Show the policy in force, or decide by another one.

    What is not given stays as it is. Earlier decisions keep the bounds they were decided by. What the rule learned,
    and the certificate, start anew: a tolerance that is chosen after the data was seen needs fresh evidence. The shadow
    mode lasts over restarts; `dengine status` counts what the model would have done, and how much of that was wrong.
    """
    if settings:
        _changed(
            "policy", store, author, lambda engine: engine.set_policy(replace(engine.policy, **settings), author), as_json
        )
        return
    from ..engine.engine import DataEngine

    with DataEngine.open(store, reading=True) as engine:  # the cell may run meanwhile
        now = engine.policy
    if as_json:
        write_json({"verb": "policy", "store": store, "changed": False, "policy": now})
        return
    show(facts(f"{store}: the policy in force", [(name, str(value)) for name, value in asdict(now).items()]))


@corrects("dengine retrain engine.db")
def retrain(store: str, author: str, as_json: bool) -> None:
    """Train now, on the store's labels as they count.

    A candidate that fails its gate is dropped and recorded, and the version before goes on answering.
    """
    from ..engine.engine import DataEngine
    from ..experiments.tables import retrain_line
    from ..store.base import UNHURRIED

    with DataEngine.open(store, wait=UNHURRIED) as engine:
        report = engine.retrain()
        text = f"trained by hand on {report.n_traces} traces: {report.reason}"
        engine.store.put_event("retrain", text, asdict(report), author)
    if as_json:
        write_json({"verb": "retrain", "store": store, "author": author, "retrain": report})
    else:
        answers = f"Version {report.version} answers." if report.version else "No version answers yet."
        show(f"{answers} {retrain_line([report])}")
    if not report.accepted:
        raise click.ClickException(f"The retrain was {report.reason}.")
