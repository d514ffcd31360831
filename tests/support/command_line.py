"""Runs the `dengine` command in this process, for tests of verbs."""

import json
import shlex
from tempfile import gettempdir

from click.testing import CliRunner, Result

from dengine.cli import main
from dengine.cli.output import SCREEN_WIDTH


def dengine(*words: object) -> Result:
    """Run a verb with its words; return its exit code and output."""
    return CliRunner().invoke(main, [str(word) for word in words])


def well(*words: object) -> Result:
    """Run a verb that must end with exit code 0; return its result.

    Its output must fit 80 columns, uncut, except for JSON, help, paths and a history.
    """
    result = dengine(*words)
    assert result.exit_code == 0, result.output
    if not {"--json", "--help", "history"} & set(words):
        assert not [
            line
            for line in result.stdout.splitlines()
            if len(line) > SCREEN_WIDTH and gettempdir() not in line
        ]
        assert "\u2026" not in result.stdout  # how rich marks what it has cut
    return result


def succeed(*words: object) -> str:
    """Return what a verb prints that must succeed."""
    return well(*words).stdout


def line_of(*words: object) -> str:
    """Return what a verb prints in one line, without the borders of tables."""
    return " ".join(succeed(*words).replace("│", " ").replace("┃", " ").split())


def refused(*words: object) -> str:
    """Return in one line the error of a verb that must end with exit code 1."""
    result = dengine(*words)
    assert result.exit_code == 1, result.output
    return " ".join(result.stderr.split())


def document(*words: object) -> dict:
    """Return the JSON document of a verb, which must print nothing else."""
    result = well(*words, "--json")
    assert result.stderr == ""
    return json.loads(result.stdout)


def example_of(verb: str) -> list[str]:
    """Return the words of the command in which the help of a verb ends."""
    lines = succeed(verb, "--help").rstrip().splitlines()
    assert lines[-2].strip() == "Example:"
    return shlex.split(lines[-1])
