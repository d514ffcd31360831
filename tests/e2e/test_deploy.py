"""The container file and the service: every file, option and name in them is there.

No image is built and none is run.
"""

import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from contextlib import nullcontext
from pathlib import Path

import click
import pytest

pytest.importorskip("uvicorn", reason="needs the extra serve: pip install 'dengine[serve]'")

from dengine.cli import main
from dengine.errors import SettingError
from dengine.records import Action, Reason
from dengine.serve.auth import read_tokens
from dengine.serve.http import create_app
from dengine.serve.metrics import Metrics
from tests.support.command_line import dengine, well
from tests.support.serving import a_service, served

REPO = Path(__file__).resolve().parents[2]
DEPLOY = REPO / "dengine" / "serve" / "deploy"
CONTAINER, UNIT, OPTIONS = (
    (DEPLOY / name).read_text(encoding="utf-8")
    for name in ("Containerfile", "dengine.service", "dengine.env")
)
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def steps(name: str) -> list[str]:
    """What a kind of step of the container file says, continued lines in one, without comments."""
    lines = "\n".join(line for line in CONTAINER.splitlines() if not line.startswith("#")).replace(
        "\\\n", " "
    )
    return [
        line.split(maxsplit=1)[1].strip()
        for line in lines.splitlines()
        if line.split(maxsplit=1)[:1] == [name]
    ]


def settings(name: str) -> list[str]:
    """The values of a setting of the unit, in order."""
    return re.findall(rf"^{name}=(.*)$", UNIT, flags=re.M)


def parse(words: list[str]) -> click.Context:
    """`dengine serve ...` as the command line reads it; UsageError for an option that does not
    exist.
    """
    with click.Context(main, **main.context_settings) as parent:
        return main.commands[words[0]].make_context(words[0], list(words[1:]), parent=parent)


def test_the_recipe_for_windows_installs_extras_and_runs_tests_and_verbs_that_there_are() -> None:
    recipe = (REPO / ".ci" / "windows.yml").read_text(encoding="utf-8")
    paths = re.findall(r"\btests/[\w/.]+", recipe)
    assert [path for path in paths if not (REPO / path).exists()] == []
    (extras,) = re.findall(r'"\.\[([\w,]+)\]"', recipe)
    assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"])
    commands = re.findall(r"run: dengine (.+)", recipe)
    assert len(commands) >= 4
    for command in commands:
        parse(shlex.split(command))
    assert "://" not in recipe  # no index is named


def test_the_examples_are_written_by_serve_into_a_new_folder_alone(tmp_path: Path) -> None:
    written = well("serve", "--deploy", tmp_path / "deploy")
    assert "README.md says what each file is for" in " ".join(written.stdout.split())
    contents = {path.name: path.read_bytes() for path in (tmp_path / "deploy").iterdir()}
    assert contents == {path.name: path.read_bytes() for path in DEPLOY.iterdir()}
    assert {*re.findall("^. `([^`]+)` .", contents["README.md"].decode(), flags=re.M)} == (
        set(contents) - {"README.md"}
    )
    refused = dengine("serve", "--deploy", tmp_path / "deploy")
    assert (refused.exit_code, "Expected a new or an empty folder" in refused.stderr) == (1, True)


def test_the_container_gets_the_wheel_alone_and_the_projects_python_torch_and_extras() -> None:
    (copied,) = steps("COPY")
    wheel, _ = copied.split()
    kept = (DEPLOY / "Containerfile.dockerignore").read_text(encoding="utf-8").splitlines()
    assert [line for line in kept if not line.startswith("#")] == ["*", f"!{wheel}"]
    (install,) = [step for step in steps("RUN") if "pip install" in step]
    (pinned,) = re.findall("^torch==.*$", (REPO / "constraints.txt").read_text(), flags=re.M)
    assert f" {pinned} " in install
    (extras,) = re.findall(rf'"\$\(echo {re.escape(wheel)}\)\[([\w,]+)\]"', install)
    assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"])
    (minor,) = re.findall(r"python:3\.(\d+)-slim$", *steps("FROM"))
    low, high = re.findall(r"3\.(\d+)", PROJECT["requires-python"])
    assert int(low) <= int(minor) < int(high)


def test_the_container_runs_as_nobody_special_and_what_it_starts_is_an_option_each_of_serve() -> (
    None
):
    (user,), (volume,) = steps("USER"), steps("VOLUME")
    assert any(
        "useradd --system --uid 990 --user-group" in step and user in step for step in steps("RUN")
    )
    assert json.loads(steps("ENTRYPOINT")[0]) == ["dengine"]
    given = parse(json.loads(steps("CMD")[0])).params
    assert given["store"].startswith(f"{volume}/")
    assert str(given["port"]) in steps("EXPOSE")


def test_the_containers_check_passes_a_server_that_asks_for_a_token_and_fails_without_one(
    tmp_path: Path,
) -> None:
    program, *check = json.loads(steps("HEALTHCHECK")[0].split("CMD", 1)[1])
    assert program == "python"
    tokens = read_tokens(token_file(tmp_path, 0o400))
    with a_service() as service, served(create_app(service, tokens)) as port:
        asked = [sys.executable, *(word.replace(":8000/", f":{port}/") for word in check)]
        assert subprocess.run(asked, timeout=60, check=False).returncode == 0
    assert subprocess.run(asked, timeout=60, capture_output=True, check=False).returncode != 0


def token_file(folder: Path, mode: int) -> Path:
    (folder / "token").write_text(
        "a-token-of-24-characters\nanother-of-these viewer Line display\n", encoding="ascii"
    )
    (folder / "token").chmod(mode)
    return folder / "token"


@pytest.mark.parametrize(
    ("mode", "handed", "taken"),
    [(0o440, True, True), (0o440, False, False), (0o444, True, False), (0o460, True, False)],
)
def test_a_token_that_systemd_hands_over_is_taken_though_its_acl_shows_as_a_right_of_the_group(
    mode: int, handed: bool, taken: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if handed:
        monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    with nullcontext() if taken else pytest.raises(SettingError, match="only its owner may use"):
        tokens = read_tokens(token_file(tmp_path, mode))
        assert [(item.operates, item.name) for item in tokens] == [
            (True, ""),
            (False, "Line display"),
        ]


def test_the_unit_starts_serve_with_the_options_of_its_file_and_its_token_as_a_credential() -> None:
    (line,) = settings("ExecStart")
    (behind,) = re.findall(r"^DENGINE_OPTIONS=(.*)$", OPTIONS, flags=re.M)
    program, *words = shlex.split(line.replace("$DENGINE_OPTIONS", behind))
    assert Path(program).name == "dengine"
    assert settings("EnvironmentFile") == ["/etc/dengine/dengine.env"]
    given = parse(words).params
    assert given["store"].startswith(f"/var/lib/{settings('StateDirectory')[0]}/")
    assert (given["host"], given["shadow"]) == ("127.0.0.1", True)
    assert settings("LoadCredential") == ["token:/etc/dengine/token"]
    assert "${CREDENTIALS_DIRECTORY}/token" in line
    assert "token" not in OPTIONS


def test_dashboard_and_alerts_ask_for_metrics_that_there_are_and_for_their_labels() -> None:
    with a_service() as service:
        names = set(re.findall(r"^# TYPE (\w+)", Metrics(service).text()[0].decode(), flags=re.M))
    dashboard = json.loads((DEPLOY / "grafana.json").read_text(encoding="utf-8"))
    asked = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    asked += re.findall(
        r"expr: (?:>-)?\s*(.+?)\n +(?:for|annotations|labels):",
        (DEPLOY / "alerts.yml").read_text(),
        flags=re.S,
    )
    assert {
        re.sub("_(count|bucket)$", "", name) for name in re.findall(r"dengine_\w+", " ".join(asked))
    } <= names
    text = re.findall(r'(?:action|reason)="(\w+)"', " ".join(asked))
    assert (
        {"accept", "novel", "outside"} <= set(text) <= {item.value for item in (*Action, *Reason)}
    )
    assert set(re.findall(r'(\w+)=~?"', " ".join(asked))) == {
        "instance",
        "action",
        "repeated",
        "reason",
        "accepted",
        "job",
    }


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not here")
def test_systemd_finds_nothing_wrong_with_the_unit_and_rates_it_as_little_exposed(
    tmp_path: Path,
) -> None:
    def analyze(*words: str) -> subprocess.CompletedProcess[str]:
        command = ["systemd-analyze", *words, str(unit)]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)

    unit = (
        tmp_path / "dengine.service"
    )  # with a program that is here in the place of the one that it would start
    unit.write_text(
        UNIT.replace(settings("ExecStart")[0].split()[0], sys.executable), encoding="utf-8"
    )
    done = analyze("verify", "--man=no")
    assert (done.returncode, done.stderr) == (0, "")
    if "--offline" in analyze("--help").stdout:
        done = analyze("security", "--offline=yes", "--threshold=20", "--no-pager")
        assert done.returncode == 0, done.stdout[-300:]
