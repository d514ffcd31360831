"""The page of the command line, written from the commands themselves: no option is copied by hand."""

from __future__ import annotations

import html
import inspect
import re
from typing import Any

import click

from dengine.cli import main

MARK = "<!-- every verb of dengine -->"


def on_page_markdown(markdown: str, **others: Any) -> str:
    """MkDocs has read a page: the mark gives way to the verbs."""
    return markdown.replace(MARK, "\n".join(section(name, verb) for name, verb in main.commands.items()))


def section(name: str, verb: click.Command) -> str:
    """A verb: its words, its usage, its options and its example."""
    context = click.Context(verb, info_name=f"dengine {name}", help_option_names=["-h", "--help"])
    usage = " ".join([context.command_path, *verb.collect_usage_pieces(context)])
    records = [p.get_help_record(context) for p in verb.get_params(context) if isinstance(p, click.Option)]
    rows = [f"| <code>{cell(option)}</code> | {cell(text)} |" for option, text in filter(None, records)]
    table = "\n".join(["| option | what it does |", "| --- | --- |", *rows])
    return f"\n## dengine {name}\n\n```text\n{usage}\n```\n\n{words(verb.help)}\n\n{table}\n{example(verb.epilog)}"


def words(text: str | None) -> str:
    """A help text; click's mark for kept lines is not Markdown's."""
    return inspect.cleandoc(text or "").replace("\b", "")


def cell(text: str) -> str:
    """Text for a cell of a table, on one line; what Markdown would take for a link or the cell's end is written out."""
    plain = html.escape(re.sub(r"\s+", " ", text).strip(), quote=False)
    return plain.replace("|", "&#124;").replace("[", "&#91;").replace("]", "&#93;").replace("*", "&#42;")


def example(epilog: str | None) -> str:
    """The command at the end of a verb's help."""
    commands = [line.strip() for line in (epilog or "").splitlines() if line.strip().startswith("dengine ")]
    return "\n```sh\n" + "\n".join(commands) + "\n```\n" if commands else ""
