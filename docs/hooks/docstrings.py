"""Prepares the docstrings of dengine for the reference pages.

mkdocstrings reads them as numpydoc. The extension `FencedExamples` makes blocks of code of examples
that stand in running text, which Markdown would take for quotations.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

# Lines from `>>>` up to an empty line.
EXAMPLE = re.compile(r"^>>> .*(?:\n.+)*", flags=re.MULTILINE)
EXAMPLES_SECTION = re.compile(r"^Examples\n-{3,}$", flags=re.MULTILINE)


def fence_examples(text: str) -> str:
    """Return a docstring with its examples as fenced code; an Examples section is left as it is."""
    if EXAMPLES_SECTION.search(text):
        return text
    return EXAMPLE.sub(lambda match: f"```pycon\n{match[0]}\n```", text)


class FencedExamples(Extension):
    """Gives mkdocstrings each docstring with fenced examples."""

    def on_object(self, *, obj: Object, **others: Any) -> None:
        """Rewrite the docstring of an object that Griffe has read."""
        if obj.docstring is not None:
            obj.docstring.value = fence_examples(obj.docstring.value)
