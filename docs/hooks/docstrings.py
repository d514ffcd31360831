"""The docstrings of dengine as Markdown: "name : what it is" becomes a list, an example or a drawing a block of code.

They are free prose, written to be read in the source. Griffe hands each to `Readable`, mkdocstrings shows what it gives.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

ENTRY = re.compile(r"^(?P<names>\*{0,2}\w+(?: \([\w, ]*\) \w+)?(?:, \*{0,2}\w+)*) : (?P<text>.*)$")
NEXT_ENTRY = re.compile(r"  (?=\*{0,2}\w+(?: \([\w, ]*\) \w+)?(?:, \*{0,2}\w+)* : )")  # two entries on one line
INDENT = "    "


def as_markdown(text: str) -> str:
    """A docstring as Markdown."""
    lines, i, made = text.splitlines(), 0, list[str]()
    while i < len(lines):
        if is_code(lines, i):
            end = code_end(lines, i)
            made += fenced(lines[i:end])
            i = end
        elif ENTRY.match(lines[i]):
            end = entry_end(lines, i)
            made += entries([line.strip() for line in lines[i:end]], begins=not made or not made[-1].startswith("- "))
            i = end
        else:
            after_list = bool(made and made[-1].startswith("- ") and lines[i].strip())
            made += ["", lines[i]] if after_list else [lines[i]]
            i += 1
    return "\n".join(made)


def is_code(lines: list[str], i: int) -> bool:
    """Whether an example or a drawing begins at line i: `>>>`, or an indented block after an empty line."""
    if lines[i].lstrip().startswith(">>>"):
        return True
    return lines[i].startswith(INDENT) and (i == 0 or not lines[i - 1].strip())


def code_end(lines: list[str], i: int) -> int:
    """The line after that block: its indented lines, empty ones between them; of a plain `>>>`, up to an empty line."""
    if not lines[i].startswith(INDENT):
        return next((j for j in range(i, len(lines)) if not lines[j].strip()), len(lines))
    last = i
    for j in range(i, len(lines)):
        if lines[j].strip() and not lines[j].startswith(INDENT):
            break
        last = j if lines[j].strip() else last
    return last + 1


def entry_end(lines: list[str], i: int) -> int:
    """The line after an entry: what is indented below it belongs to it."""
    j = i + 1
    while j < len(lines) and lines[j].startswith(INDENT) and lines[j].strip():
        j += 1
    return j


def entries(lines: list[str], begins: bool) -> list[str]:
    """List items of the entries on these lines, one or more; an empty line before where the list begins."""
    made = [""] if begins else []
    for each in NEXT_ENTRY.split(" ".join(lines[:1]) + "".join(" " + line for line in lines[1:])):
        found = ENTRY.match(each.strip())
        names = ", ".join(f"`{name}`" for name in found["names"].split(", ")) if found else ""
        made.append(f"- {names}: {found['text'].strip()}" if found else f"- {each.strip()}")
    return made


def fenced(lines: list[str]) -> list[str]:
    """A block of code; Python where it shows a prompt."""
    depth = min(len(line) - len(line.lstrip()) for line in lines if line.strip())
    language = "pycon" if any(line.lstrip().startswith(">>>") for line in lines) else "text"
    return ["", f"```{language}", *(line[depth:] for line in lines), "```", ""]


class Readable(Extension):
    """Gives mkdocstrings each docstring as Markdown."""

    def on_object(self, *, obj: Object, **others: Any) -> None:
        """Griffe has read an object."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
