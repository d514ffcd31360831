"""The live page in a real browser, over a demonstration as `dengine serve --demo` runs it."""

import asyncio
import csv
import os
import re
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dengine import Action, Dataset, TraceSpec
from dengine.store.sql import SqlStore
from tests.support.serving import a_service, served, started

CHROMIUM = shutil.which("chromium")


def missing(tool: str) -> None:
    if os.environ.get("DENGINE_REQUIRE_BROWSER") == "1":
        pytest.fail(f"the page's tests need {tool}")
    pytest.skip(f"the page's tests need {tool}", allow_module_level=True)


if CHROMIUM is None:
    missing("Debian's chromium")
try:
    import uvicorn  # noqa: F401
    from axe_playwright_python.sync_playwright import Axe
    from playwright.sync_api import Browser, Error, Page, expect, sync_playwright

    from dengine.serve.auth import Token
    from dengine.serve.http import create_app
    from dengine.serve.service import CellService
except ImportError as error:
    missing(str(error))

FLAGS = (
    "--no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
)
# Its own look-ups stall it where no name server answers.
NO_NAMES = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
PATIENT = 60_000  # ms: a loaded machine
VIEWS = ("", "overview", "map", "history", "actions")
AUTHOR = "<script>document.title='owned'</script> Kim"


@dataclass(frozen=True)
class DemoCell:
    """A demonstration that runs: where its page is, and what it remembers in."""

    url: str
    file: Path

    def store(self):
        return SqlStore(str(self.file))


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    # The policy of the demonstration; pca, since no page shows how long a reducer trains.
    words = "--demo --reducer pca --alpha 0.1 --lower-bound 0.9 --audit-rate 0.05"
    with started(folder, *words.split()) as process:
        yield DemoCell(f"http://127.0.0.1:{process.port}", folder / "cell.db")
        process.end()


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as playwright:  # each launch has a new folder for its profile
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=[*FLAGS.split(), NO_NAMES]
        )
        yield browser
        browser.close()


@contextmanager
def looking(browser: Browser, **options: Any) -> Iterator[Page]:
    """A page of its own, which has no error, opens no dialog, for strange numbers stay text, and
    asks nobody but its own server.
    """
    asked: list[str] = []
    complaints: list[object] = []
    size = {"viewport": {"width": 1280, "height": 720}}
    with browser.new_context(**{"locale": "en-GB"} | size | options) as context:
        context.set_default_timeout(PATIENT)
        context.on("request", lambda request: asked.append(request.url))
        page = context.new_page()
        page.on("pageerror", lambda error: complaints.append(error))
        page.on("dialog", lambda dialog: complaints.append(dialog))
        yield page
        custom = page.url.partition("://")[2].partition("/")[0]
    assert complaints == []
    assert [url for url in asked if f"://{custom}/" not in url] == []


def opened(page: Page, demo: DemoCell, view: str = "") -> None:
    page.goto(f"{demo.url}/{view}")
    expect(page.locator("#link")).to_have_attribute("data-state", "live", timeout=PATIENT)
    expect(page.locator("h1")).to_be_attached(
        timeout=PATIENT
    )  # of the view, once the server has answered


def confirmed(page: Page, button: str, label: str = "", text: str = "") -> None:
    """Click a button and confirm; label, text : what is filled in before that."""
    page.get_by_role("button", name=button).click()
    if label:
        page.get_by_label(label).fill(text)
    page.get_by_role("button", name="Do it").click()
    expect(page.get_by_role("dialog")).to_be_hidden(timeout=PATIENT)


@contextmanager
def cell(
    file: Path, tokens: tuple[Token, ...] = (), trace: TraceSpec | None = None
) -> Iterator[tuple[CellService, DemoCell]]:
    """A service in this process, and where its page is."""
    with a_service(file, trace=trace) as service, served(create_app(service, tokens)) as port:
        yield service, DemoCell(f"http://127.0.0.1:{port}", file)


def test_a_decision_appears_and_the_next_one_takes_its_place(browser, demo):
    with looking(browser) as page:
        opened(page, demo)
        decision = page.locator("#decision")
        expect(decision).to_have_text(re.compile("Accept|Reject|Verify"), timeout=PATIENT)
        expect(page.locator("#trace .chart canvas")).to_be_visible()
        about = page.locator(".decision .about")
        was = about.inner_text()
        expect(about).not_to_have_text(was, timeout=PATIENT)
        # It was told, and never loaded again.
        assert page.evaluate("performance.getEntriesByType('navigation').length") == 1


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_rules_of_axe_pass_and_a_phone_need_not_scroll_sideways(browser, demo, scheme):
    phone = {"viewport": {"width": 390, "height": 844}}
    with looking(browser, color_scheme=scheme, **phone) as page:
        opened(page, demo, "map")
        expect(page.locator("a.mark.good").first).to_be_attached(timeout=PATIENT)
        part = page.locator("a.mark").first.get_attribute("href").removeprefix("/")
        for view in (*VIEWS, part, part.replace("map", "part"), "the policy"):
            if view == "the policy":
                opened(page, demo, "actions")
                page.get_by_role("button", name="Change the policy").click()
            else:
                opened(page, demo, view)
            assert page.evaluate("document.documentElement.scrollWidth") <= 390, view
            completed = Axe().run(page)
            assert completed.violations_count == 0, f"{view}: {completed.generate_report()}"


def test_versions_are_rolled_back_released_and_trained_and_a_label_corrected_by_the_keyboard(
    browser, tmp_path, stream
):
    with cell(tmp_path / "cell.db") as (service, demo), looking(browser) as page:
        played(service, stream, 40)
        service.submit(lambda engine, late: engine.retrain()).result()
        opened(page, demo, "actions")
        confirmed(page, "Roll back", "Your name", AUTHOR)
        expect(page.locator("#result")).to_contain_text("Version 1 answers again")
        confirmed(page, "Release the version")
        confirmed(page, "Retrain now")
        expect(page.locator("#result")).to_have_text("The retrain has begun.")
        opened(page, demo, "part?id=order-0")
        page.get_by_role("button", name=re.compile("It was")).first.press("Enter")
        page.keyboard.press("Enter")
        expect(page.locator("#part .story")).to_contain_text(f"by {AUTHOR}", timeout=PATIENT)
        assert page.title().startswith("Part")  # what was typed stayed text
    with demo.store() as store:
        done = {event.kind for event in store.events.newest(20) if event.author == AUTHOR}
    assert done == {"retrain", "rollback", "release", "correct"}


TOKEN = "correct-horse-battery-staple"
STRANGE = "<img src=x onerror=alert(1)> 7"


def played(service: CellService, data: Dataset, n: int = 70) -> str:
    """The newest accepted one of n parts with strange numbers, of which nothing is heard. Of its
    two channels the second is the first backwards.
    """

    async def play():
        newest = ""
        for i in range(n):
            x = np.stack([data.X[i], data.X[i][::-1]])
            decision = (await service.decide(x, f"order-{i}", f"{STRANGE}-{i}")).decision
            if decision.action is Action.ACCEPT:
                newest = decision.part
            elif decision.action is Action.VERIFY:
                await service.report(decision.id, bool(data.y[i]))
        return newest

    with ThreadPoolExecutor(1) as thread:  # in this one Playwright's own loop runs
        return thread.submit(asyncio.run, play()).result()


def test_an_operators_day(browser, tmp_path, stream):
    viewer, kim = Token("a-viewer-s-password", False, "Line display"), Token(TOKEN, True, "Kim")
    # A rate, which limits in seconds need.
    trace = TraceSpec(60, 500.0, channels=2, unit=("kN", "mm"), columns=("FZ", "SZ"))
    with cell(tmp_path / "cell.db", (viewer, kim), trace) as (service, demo):
        part = played(service, stream)
        with (
            pytest.raises(Error, match="ERR_INVALID_AUTH_CREDENTIALS"),
            looking(browser) as page,
        ):  # it asks for a password
            page.goto(demo.url)
        with looking(browser, http_credentials=signed_in(viewer)) as page:
            opened(page, demo, "actions")
            expect(page.locator("#me")).to_contain_text("Line display")
            expect(page.get_by_role("button", name="Verify everything")).to_be_disabled()
        with looking(browser, http_credentials=signed_in(kim)) as page:
            a_day(page, demo, part, tmp_path / "list.csv")
            opened(page, demo, "part?id=nobody")
            expect(page.locator("h1")).to_have_text("That cannot be shown")
    with demo.store() as store:
        answers = [(event.kind, event.author) for event in store.events.newest(4)]
    kinds = ("report", "policy", "policy", "policy")
    assert answers == [(kind, "Kim") for kind in kinds]  # nobody typed a name


def a_day(page: Page, demo: DemoCell, part: str, file: Path) -> None:
    """A part that came back is found by its number, reported, and looked at; the cell verifies all
    for a while.
    """

    def shown(selector, text):
        expect(page.locator(selector)).to_contain_text(text, timeout=PATIENT)

    opened(page, demo)
    channels = page.locator("#trace figcaption")
    expect(channels).to_contain_text([re.compile(r"FZ .* kN\. "), re.compile(r"SZ .* mm\. ")])
    opened(page, demo, "history")
    page.get_by_role("link", name="Older").click()
    expect(page.get_by_role("link", name="Newest")).to_be_visible()
    page.get_by_label("Part's number").fill(f" {part} ")  # as a scanner, or a copy, gives it
    page.get_by_role("button", name="Show", exact=True).click()
    expect(page.locator("#history tbody tr")).to_have_count(1)
    page.locator("#history").get_by_role("link", name=part).click()
    confirmed(page, "It was bad")
    shown("#result", "Recorded: bad.")
    opened(page, demo, "overview")
    shown("#saved", "line stops, not subtracted: 1")
    shown("#bad", "1 known bad")
    page.locator("#escapes").get_by_role("link", name=part).click()
    shown("#part .why", "The part turned out bad (stop)")
    opened(page, demo, "actions")
    confirmed(page, "Verify everything")
    shown("#banner", "every part is verified")
    confirmed(page, "Let the model decide again")
    shown("#mode", "Decides")
    confirmed(page, "Change the policy", "Force limits", "0.01:0.05::30:reject")
    opened(page, demo, "history?label=bad")
    with page.expect_download() as download:
        page.get_by_role("button", name="Download these as CSV").click()
    download.value.save_as(file)
    rows = csv.DictReader(file.read_text(encoding="utf-8").splitlines())
    (row,) = (row for row in rows if row["part"] == part)
    assert datetime.fromisoformat(row["time"]) < datetime.fromisoformat(row["label_time"])


@pytest.mark.slow
def test_a_page_that_is_cut_off_says_so_and_comes_back(browser):
    with a_service() as service, looking(browser) as page:
        state, cut = page.locator("#link"), page.locator("#cut")
        with served(create_app(service)) as port:
            page.goto(f"http://127.0.0.1:{port}/")
            expect(state).to_have_attribute("data-state", "live", timeout=PATIENT)
        expect(cut).to_contain_text("What you see is old", timeout=PATIENT)
        with served(create_app(service), port):
            expect(state).to_have_attribute("data-state", "live", timeout=PATIENT)
            expect(cut).to_be_hidden()


def signed_in(token: Token) -> dict[str, str]:
    return {"username": "anybody", "password": token.secret}
