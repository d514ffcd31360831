"""The container file and the service: every file, option and name in them is there.

No image is built and none is run.
"""

import json
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click
import pytest

pytest.importorskip("uvicorn", reason="needs the extra serve: pip install 'dengine[serve]'")

from dengine.cli import main
from dengine.errors import SettingError
from dengine.records import Action, Reason
from dengine.serve.auth import read_tokens
from dengine.serve.http import create_app
from dengine.serve.metrics import Metrics
from tests.support.command_line import refused, well
from tests.support.serving import REPO, a_service, served

DEPLOY = REPO / "dengine" / "serve" / "deploy"
CONTAINER, UNIT, OPTIONS = (
    (DEPLOY / name).read_text(encoding="utf-8")
    for name in ("Containerfile", "dengine.service", "dengine.env")
)


def steps(name: str) -> list[str]:
    """What a kind of step of the container file says, continued lines in one, without comments."""
    lines = re.sub(r"^#.*\n", "", CONTAINER, flags=re.M).replace("\\\n", " ")
    return re.findall(rf"^{name}\s+(.*?)\s*$", lines, flags=re.M)


def settings(name: str) -> list[str]:
    """The values of a setting of the unit, in order."""
    return re.findall(rf"^{name}=(.*)$", UNIT, flags=re.M)


def parse(words: list[str]) -> dict[str, Any]:
    """The options of a command as the command line reads it; UsageError for one that does not
    exist.
    """
    with click.Context(main, **main.context_settings) as parent:
        return main.commands[words[0]].make_context(words[0], words[1:], parent=parent).params


def test_the_examples_are_written_by_serve_into_a_new_folder_alone(tmp_path):
    folder = tmp_path / "deploy"
    well("serve", "--deploy", folder)
    contents = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert contents == {path.name: path.read_bytes() for path in DEPLOY.iterdir()}
    readme = contents.pop("README.md").decode()
    assert {*re.findall("^. `([^`]+)` .", readme, flags=re.M)} == {*contents}
    assert "Expected a new or an empty folder" in refused("serve", "--deploy", folder)


def test_what_the_container_starts_is_an_option_each_of_serve():
    assert json.loads(steps("ENTRYPOINT")[0]) == ["dengine"]
    given = parse(json.loads(steps("CMD")[0]))
    assert given["store"].startswith(f"{steps('VOLUME')[0]}/")
    assert str(given["port"]) in steps("EXPOSE")


def test_the_containers_check_passes_a_server_that_asks_for_a_token_and_fails_without_one(
    tmp_path,
):
    program, *check = json.loads(steps("HEALTHCHECK")[0].split("CMD", 1)[1])
    assert program == "python"
    tokens = read_tokens(token_file(tmp_path, 0o400))
    with a_service() as service, served(create_app(service, tokens)) as port:
        asked = [sys.executable, *(word.replace(":8000/", f":{port}/") for word in check)]
        assert subprocess.run(asked, timeout=60, check=False).returncode == 0
    assert subprocess.run(asked, timeout=60, capture_output=True, check=False).returncode != 0


def token_file(folder: Path, mode: int) -> Path:
    file = folder / "token"
    file.write_text("a-token-of-24-characters\nanother-of-these viewer Line display\n")
    file.chmod(mode)
    return file


@pytest.mark.parametrize(
    ("mode", "handed", "taken"),
    [(0o440, True, True), (0o440, False, False), (0o444, True, False), (0o460, True, False)],
)
def test_a_token_that_systemd_hands_over_is_taken_though_its_acl_shows_as_a_right_of_the_group(
    mode, handed, taken, tmp_path, monkeypatch
):
    if handed:
        monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    with nullcontext() if taken else pytest.raises(SettingError, match="only its owner may use"):
        one, other = read_tokens(token_file(tmp_path, mode))
        assert (one.operates, other.operates, other.name) == (True, False, "Line display")


def test_the_unit_starts_serve_with_the_options_of_its_file_and_its_token_as_a_credential():
    (behind,) = re.findall(r"^DENGINE_OPTIONS=(.*)$", OPTIONS, flags=re.M)
    line = settings("ExecStart")[0].replace("$DENGINE_OPTIONS", behind)
    assert "${CREDENTIALS_DIRECTORY}/token" in line
    assert settings("LoadCredential") == ["token:/etc/dengine/token"]
    assert settings("EnvironmentFile") == ["/etc/dengine/dengine.env"]
    given = parse(shlex.split(line)[1:])
    assert given["store"].startswith(f"/var/lib/{settings('StateDirectory')[0]}/")
    assert (given["host"], given["shadow"]) == ("127.0.0.1", True)


def test_dashboard_and_alerts_ask_for_metrics_actions_and_reasons_that_there_are():
    with a_service() as service:
        names = re.findall(r"^# TYPE (\w+)", Metrics(service).text().decode(), flags=re.M)
    texts = [(DEPLOY / name).read_text(encoding="utf-8") for name in ("grafana.json", "alerts.yml")]
    exprs = re.findall(r'"expr": "((?:[^"\\]|\\.)+)"', texts[0])
    exprs += re.findall(
        r"expr: (?:>-)?\s*(.+?)\n +(?:for|annotations|labels):", texts[1], flags=re.S
    )
    asked = " ".join(exprs).replace('\\"', '"')
    metrics = re.findall(r"dengine_\w+", asked)
    assert {re.sub("_(count|bucket)$", "", name) for name in metrics} <= {*names}
    values = {*re.findall(r'(?:action|reason)="(\w+)"', asked)}
    assert {"accept", "novel", "outside"} <= values <= {item.value for item in (*Action, *Reason)}


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not here")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path):
    unit = tmp_path / "dengine.service"
    # With a program that is here in the place of the one that it would start.
    unit.write_text(UNIT.replace(settings("ExecStart")[0].split()[0], sys.executable))
    command = ["systemd-analyze", "verify", "--man=no", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
