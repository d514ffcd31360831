"""A database's password is shown nowhere: not in errors, tables, progress or JSON."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from dengine import errors as all_errors
from dengine.cli import main
from dengine.cli.output import progress_bar
from dengine.errors import DengineError, StoreError, without_password
from dengine.representation import to_jsonable
from dengine.store import SqlStore
from tests.support.command_line import dengine
from tests.support.tables import rows

SECRET = "hunter2"
NOBODY = f"postgresql+psycopg://robot:{SECRET}@127.0.0.1:1/cell"
ERRORS = [
    value
    for value in vars(all_errors).values()
    if isinstance(value, type) and issubclass(value, DengineError)
]


MASKED = f"""
a {NOBODY} b > a postgresql+psycopg://robot:***@127.0.0.1:1/cell b
'postgresql://u:a@b:{SECRET}/x@host/db' > 'postgresql://u:***@host/db'
postgresql://:{SECRET}@host/db > postgresql://:***@host/db
postgresql://u:my {SECRET}@host/db > postgresql://u:***@host/db
postgresql://h/db?user=u&password={SECRET}&x=1 > postgresql://h/db?user=u&password=***&x=1
host=h password={SECRET} user=u > host=h password=*** user=u
postgresql://user@host:5432/db > postgresql://user@host:5432/db
sqlite:///a.db and me@home > sqlite:///a.db and me@home
C:\\cell.db, 12:30 > C:\\cell.db, 12:30
"""


def test_a_password_is_masked_and_all_else_stays():
    for text, shown in rows(MASKED, at=" > "):
        assert without_password(text) == shown


@pytest.mark.parametrize("kind", ERRORS)
def test_every_error_masks_what_it_says(kind):
    for error in (kind(f"no {NOBODY}"), pickle.loads(pickle.dumps(kind(f"no {NOBODY}")))):
        assert SECRET not in f"{error} {error!r} {error.args!r}"
        assert "robot:***@" in str(error)


NO_URLS = f"""postgresql://u:{SECRET}@a:{SECRET}@host/db sqlite://u:{SECRET}@/a.db {NOBODY}
mysql://u:{SECRET}@host/db sqlite:// sqlite:///:memory: nonsense://x a://:b:c"""


@pytest.mark.parametrize("url", NO_URLS.split())
def test_a_url_that_cannot_be_used_is_refused_without_its_password_in_the_whole_chain(url):
    with pytest.raises(StoreError) as caught:
        SqlStore(url)
    error: BaseException | None = caught.value
    while error is not None:
        assert SECRET not in str(error)
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


CALLS = """
status URL
status URL --json
train --data insertion --store URL
run --cycles 1 --store URL
serve --port 0 --store URL
export URL --out model.ts
import-labels journal.csv --store URL
report URL 5 bad
explain URL last
correct URL a bad
forget URL a
rollback URL 1
policy URL --alpha 0.1 --shadow on
history URL
verify URL
retrain URL
backup URL --out copy.db
restore copy.db --store URL
release URL
URL
status --store=URL
status a.db URL
data URL
"""  # every verb that takes a store, and what click repeats


def test_no_verb_shows_the_password_of_what_it_cannot_use(tmp_path, monkeypatch):
    verbs = main.commands.items()
    takes = {name for name, verb in verbs if "store" in [option.name for option in verb.params]}
    assert takes <= {words[0] for words in rows(CALLS)}
    monkeypatch.chdir(tmp_path)
    Path("journal.csv").write_text("1,0.0\n")
    for words in rows(CALLS.replace("URL", NOBODY)):
        done = dengine(*words)
        assert done.exit_code in (1, 2), words
        assert SECRET not in done.output


def test_json_and_progress_mask_it(capsys):
    nested = {"store": NOBODY, "all": [NOBODY, (NOBODY, np.float64)], "path": Path(NOBODY)}
    assert SECRET not in json.dumps(to_jsonable(nested))
    with progress_bar(f"importing {NOBODY}", 3) as advance:
        advance(3)
    assert SECRET not in "".join(capsys.readouterr())
