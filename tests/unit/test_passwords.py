"""A database's password is shown nowhere: not in errors, tables, progress or JSON."""

import json
import os
import pickle
from pathlib import Path

import pytest
import sqlalchemy as sa

from dengine import errors as all_errors
from dengine.cli import main
from dengine.cli.output import progress_bar
from dengine.errors import DengineError, StoreError, without_password
from dengine.representation import to_jsonable
from dengine.store import SqlStore
from dengine.store.connections import make_engine
from tests.support.command_line import dengine

SECRET = "hunter2"
POSTGRES = os.environ.get("DENGINE_TEST_POSTGRES", "")
NOBODY = f"postgresql+psycopg://robot:{SECRET}@127.0.0.1:1/cell"
ERRORS = [
    value
    for value in vars(all_errors).values()
    if isinstance(value, type) and issubclass(value, DengineError)
]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (f"a {NOBODY} b", "a postgresql+psycopg://robot:***@127.0.0.1:1/cell b"),
        (f"'postgresql://u:a@b:{SECRET}/x@host/db'", "'postgresql://u:***@host/db'"),
        (f"postgresql://:{SECRET}@host/db", "postgresql://:***@host/db"),
        (f"postgresql://u:my {SECRET}@host/db", "postgresql://u:***@host/db"),
        (
            f"postgresql://h/db?user=u&password={SECRET}&x=1",
            "postgresql://h/db?user=u&password=***&x=1",
        ),
        (f"host=h password={SECRET} user=u", "host=h password=*** user=u"),
        *(
            (text, text)
            for text in (
                "postgresql://user@host:5432/db",
                "sqlite:///a.db and me@home",
                "C:\\cell.db, 12:30",
            )
        ),
    ],
)
def test_a_password_is_masked_and_all_else_stays(text: str, shown: str) -> None:
    assert without_password(text) == shown


@pytest.mark.parametrize("kind", ERRORS, ids=lambda kind: kind.__name__)
def test_every_error_masks_what_it_says(kind: type[DengineError]) -> None:
    for error in (kind(f"no {NOBODY}"), pickle.loads(pickle.dumps(kind(f"no {NOBODY}")))):
        assert SECRET not in str(error) + repr(error) + repr(error.args)
        assert "robot:***@" in str(error)


NO_URLS = f"postgresql://u:{SECRET}@a:{SECRET}@host/db sqlite://u:{SECRET}@/a.db mysql://u:{SECRET}@host/db {NOBODY} "
NO_URLS += "sqlite:// sqlite:///:memory: nonsense://x a://:b:c"


@pytest.mark.parametrize("url", NO_URLS.split())
def test_a_url_that_cannot_be_used_is_refused_without_its_password_in_the_whole_chain(
    url: str,
) -> None:
    with pytest.raises(StoreError) as caught:
        SqlStore(url)
    error: BaseException | None = caught.value
    while error is not None:
        assert SECRET not in str(error)
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


CALLS = [  # every verb that takes a store, and what click repeats
    f"status {NOBODY}", f"status {NOBODY} --json", f"train --data insertion --store {NOBODY}",
    f"run --cycles 1 --store {NOBODY}", f"serve --port 0 --store {NOBODY}", f"export {NOBODY} --out model.ts",
    f"import-labels journal.csv --store {NOBODY}", f"report {NOBODY} 5 bad",
    f"explain {NOBODY} last", f"correct {NOBODY} a bad", f"forget {NOBODY} a", f"rollback {NOBODY} 1",
    f"policy {NOBODY} --alpha 0.1 --shadow on", f"history {NOBODY}", f"verify {NOBODY}", f"retrain {NOBODY}",
    f"backup {NOBODY} --out copy.db",
    f"restore copy.db --store {NOBODY}",
    f"release {NOBODY}",
    NOBODY, f"status --store={NOBODY}", f"import-labels {NOBODY} --store a.db",
    f"status a.db {NOBODY}", f"data {NOBODY}",
]  # fmt: skip


@pytest.mark.parametrize("words", CALLS)
def test_no_verb_shows_the_password_of_what_it_cannot_use(
    words: str, tmp_path: Path, monkeypatch
) -> None:
    takes = {
        name
        for name, verb in main.commands.items()
        if any(option.name == "store" for option in verb.params)
    }
    assert takes <= {words.split()[0] for words in CALLS}
    monkeypatch.chdir(tmp_path)
    Path("journal.csv").write_text("1,0.0\n")
    done = dengine(*words.split())
    assert done.exit_code in (1, 2)
    assert SECRET not in done.output


def test_json_and_progress_mask_it(capsys: pytest.CaptureFixture) -> None:
    assert SECRET not in json.dumps(
        to_jsonable({"store": NOBODY, "all": [NOBODY, (NOBODY,)], "path": Path(NOBODY)})
    )
    with progress_bar(f"importing {NOBODY}", 3) as advance:
        advance(3)
    assert SECRET not in "".join(capsys.readouterr())


@pytest.mark.skipif(not POSTGRES, reason="DENGINE_TEST_POSTGRES is unset: . .ci/postgres.sh")
def test_the_environment_gives_the_password(monkeypatch) -> None:
    with_it = sa.make_url(POSTGRES).set(password=SECRET)
    monkeypatch.setenv("PGPASSWORD", SECRET)
    with make_engine(
        with_it._replace(password=None).render_as_string(hide_password=False)
    ).connect() as connection:
        assert connection.connection.driver_connection.info.password == SECRET
