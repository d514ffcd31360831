"""The `dengine` command in this process: what it printed, and with which exit code."""

import json
from tempfile import gettempdir

from click.testing import CliRunner, Result

from dengine.cli import main
from dengine.cli.output import SCREEN_WIDTH


def dengine(*words: object) -> Result:
    """A verb and its words."""
    return CliRunner().invoke(main, [str(word) for word in words])


def well(*words: object) -> Result:
    """A verb that must end well; but for JSON, help, paths and a history its output fits 80 columns, uncut."""
    result = dengine(*words)
    assert result.exit_code == 0, result.output
    if not {"--json", "--help", "history"} & set(words):
        assert not [line for line in result.stdout.splitlines() if len(line) > SCREEN_WIDTH and gettempdir() not in line]
        assert "\u2026" not in result.stdout  # how rich marks what it has cut
    return result


def succeed(*words: object) -> str:
    """What a verb that ends well prints."""
    return well(*words).stdout


def said(*words: object) -> str:
    """The same in one line, without the lines of tables."""
    return " ".join(succeed(*words).replace("│", " ").replace("┃", " ").split())


def document(*words: object) -> dict:
    """Its JSON document, and nothing else."""
    result = well(*words, "--json")
    assert result.stderr == ""
    return json.loads(result.stdout)
