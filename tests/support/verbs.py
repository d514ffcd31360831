"""Run several verbs in one new process, which loads torch once.

    python -m tests.support.verbs '[["status", "engine.db"], ["verify", "engine.db"]]'

Prints a JSON list with the exit code, the output and whether an error was not foreseen, of each.
"""

import json
import sys
from typing import Any

from click.testing import CliRunner

from dengine.cli import main


def run(words: list[str]) -> dict[str, Any]:
    """Run a verb, as it is typed."""
    result = CliRunner().invoke(main, words)
    unforeseen = result.exception is not None and not isinstance(result.exception, SystemExit)
    text = f"{result.output}{result.exception!r}" if unforeseen else result.output
    return {"exit_code": result.exit_code, "output": text, "unforeseen": unforeseen}


if __name__ == "__main__":
    print(json.dumps([run(words) for words in json.loads(sys.argv[1])]))
