"""The `dengine` command in this process: what it printed, and with which exit code."""

import json

from click.testing import CliRunner, Result

from dengine.cli import main


def dengine(*words: object) -> Result:
    """A verb and its words."""
    return CliRunner().invoke(main, [str(word) for word in words])


def succeed(*words: object) -> str:
    """What a verb that ends well says."""
    result = dengine(*words)
    assert result.exit_code == 0, result.output
    return result.stdout


def document(*words: object) -> dict:
    """Its JSON document, and nothing else."""
    result = dengine(*words, "--json")
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    return json.loads(result.stdout)
