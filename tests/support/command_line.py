"""The `dengine` command in this process: what it printed, and with which exit code."""

import json

from click.testing import CliRunner, Result

from dengine.cli import main


def dengine(*words: object) -> Result:
    """A verb and its words."""
    return CliRunner().invoke(main, [str(word) for word in words])


def well(*words: object) -> Result:
    """A verb that must end well."""
    result = dengine(*words)
    assert result.exit_code == 0, result.output
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
