"""Writes the reference page of the command line from the commands of dengine themselves."""

from __future__ import annotations

import html
import inspect
import re
from typing import Any

import click

from dengine.cli import main

MARK = "<!-- every verb of dengine -->"


def on_page_markdown(markdown: str, **others: Any) -> str:
    """Return a page of MkDocs with all verbs in the place of the mark."""
    return markdown.replace(
        MARK, "\n".join(section(name, verb) for name, verb in main.commands.items())
    )


def section(name: str, verb: click.Command) -> str:
    """Return the section of a verb in Markdown: usage, help, options and example."""
    context = click.Context(verb, info_name=f"dengine {name}", help_option_names=["-h", "--help"])
    usage = " ".join([context.command_path, *verb.collect_usage_pieces(context)])
    options = [item for item in verb.get_params(context) if isinstance(item, click.Option)]
    records = [option.get_help_record(context) for option in options]
    rows = [
        f"| <code>{cell(option)}</code> | {cell(text)} |" for option, text in filter(None, records)
    ]
    table = "\n".join(["| option | what it does |", "| --- | --- |", *rows])
    heading = f"\n## dengine {name}\n\n```text\n{usage}\n```"
    return f"{heading}\n\n{words(verb.help)}\n\n{table}\n{example(verb.epilog)}"


def words(text: str | None) -> str:
    """Return a help text without the mark by which click keeps line breaks."""
    return inspect.cleandoc(text or "").replace("\b", "")


def cell(text: str) -> str:
    """Return a text as one line for the cell of a table, with Markdown's characters escaped."""
    plain = html.escape(re.sub(r"\s+", " ", text).strip(), quote=False)
    for character in "|[]*":
        plain = plain.replace(character, f"&#{ord(character)};")
    return plain


def example(epilog: str | None) -> str:
    """Return the commands at the end of a verb's help as a block of code; "" without any."""
    lines = [line.strip() for line in (epilog or "").splitlines()]
    commands = [line for line in lines if line.startswith("dengine ")]
    return "\n```sh\n" + "\n".join(commands) + "\n```\n" if commands else ""
