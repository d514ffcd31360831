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

from dengine import Action, DataEngine, Dataset, Decision, TraceSpec
from dengine.store.records import KEEP
from dengine.store.sql import SqlStore
from dengine.store.views import HistoryFilter
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
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",  # its own look-ups stall it where no name server answers
)
PATIENT = 60_000  # ms: a loaded machine
VIEWS = ("", "overview", "map", "history", "actions")
AUTHOR = "<script>document.title='owned'</script> Kim"


@dataclass(frozen=True)
class DemoCell:
    """A demonstration that runs: where its page is, and what it remembers in."""

    url: str
    file: Path

    def store(self) -> SqlStore:
        return SqlStore(str(self.file))


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DemoCell]:
    folder = tmp_path_factory.mktemp("demo")
    # The policy of the demonstration; pca, since no page shows how long a reducer trains.
    words = "--demo --reducer pca --alpha 0.1 --lower-bound 0.9 --audit-rate 0.05"
    with started(folder, *words.split()) as process:
        yield DemoCell(f"http://127.0.0.1:{process.port}", folder / "cell.db")
        process.end()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:  # each launch has a new folder for its profile
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, headless=True, args=list(FLAGS)
        )
        yield browser
        browser.close()


@contextmanager
def looking(browser: Browser, **options: Any) -> Iterator[Page]:
    """A page of its own, which opens no dialog, for strange numbers stay text, and asks nobody but
    its own server.
    """
    context = browser.new_context(
        **{"viewport": {"width": 1280, "height": 720}, "locale": "en-GB"} | options
    )
    context.set_default_timeout(PATIENT)
    page, asked, dialogs = context.new_page(), list[str](), list[str]()
    context.on("request", lambda request: asked.append(request.url))
    page.on("dialog", lambda dialog: dialogs.append(dialog.message))
    yield page
    custom = page.url.partition("://")[2].partition("/")[0]
    context.close()
    assert dialogs == []
    assert [url for url in asked if f"://{custom}/" not in url] == []


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    complaints = list[str]()
    with looking(browser) as page:
        page.on(
            "console",
            lambda text: (
                complaints.append(text.text) if text.type in ("error", "warning") else None
            ),
        )
        page.on("pageerror", lambda error: complaints.append(str(error)))
        yield page
    assert complaints == []


PHONE = {"viewport": {"width": 390, "height": 844}}


def must_suit_a_phone(page: Page, view: str) -> None:
    """The rules of axe pass, and nobody needs to scroll sideways."""
    assert page.evaluate("document.documentElement.scrollWidth") <= 390, view
    completed = Axe().run(page)
    assert completed.violations_count == 0, f"{view}: {completed.generate_report()}"


def opened(page: Page, demo: DemoCell, view: str = "") -> None:
    page.goto(f"{demo.url}/{view}")
    expect(page.locator("#link")).to_have_attribute("data-state", "live", timeout=PATIENT)
    expect(page.locator("h1")).to_be_attached(
        timeout=PATIENT
    )  # of the view, once the server has answered


def with_a_model(page: Page, demo: DemoCell) -> None:
    opened(page, demo, "map")
    expect(page.locator("a.mark.good").first).to_be_attached(timeout=PATIENT)


def confirmed(page: Page, button: str, author: str = "") -> None:
    """author : "" where it is remembered, or the token has a name."""
    page.get_by_role("button", name=button).click()
    if author:
        page.get_by_label("Your name").fill(author)
    page.get_by_role("button", name="Do it").click()
    expect(page.get_by_role("dialog")).to_be_hidden(timeout=PATIENT)


@contextmanager
def cell(
    file: Path, tokens: tuple[Token, ...] = (), trace: TraceSpec | None = None
) -> Iterator[tuple[CellService, DemoCell]]:
    """A service in this process, and where its page is."""
    with a_service(file, trace=trace) as service, served(create_app(service, tokens)) as port:
        yield service, DemoCell(f"http://127.0.0.1:{port}", file)


def test_a_decision_appears_and_the_next_one_takes_its_place(page: Page, demo: DemoCell) -> None:
    opened(page, demo)
    expect(page.locator("#decision")).to_have_text(
        re.compile("Accept|Reject|Verify"), timeout=PATIENT
    )
    expect(page.locator("#trace .chart canvas")).to_be_visible()
    expect(page.locator("#trace figcaption")).to_contain_text(
        "Force over 2.0 s"
    )  # what the picture says, in words
    was = page.locator(".decision .about").inner_text()
    expect(page.locator(".decision .about")).not_to_have_text(was, timeout=PATIENT)
    assert (
        page.evaluate("performance.getEntriesByType('navigation').length") == 1
    )  # it was told, and never loaded again


@pytest.mark.slow
def test_the_map_is_gone_over_by_the_keyboard_alone(page: Page, demo: DemoCell) -> None:
    with_a_model(page, demo)
    page.locator(".skip").focus()
    focused = "document.activeElement.matches('a.mark') && document.activeElement.id"
    for _ in range(30):
        page.keyboard.press("Tab")
        if first := page.evaluate(focused):
            break
    for key in ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"):
        page.keyboard.press(key)
        if (other := page.evaluate(focused)) != first:
            break
    assert first
    assert other
    assert first != other
    page.keyboard.press("Enter")
    expect(page.locator("#part-title")).to_be_focused(timeout=PATIENT)
    expect(page.locator("#part .chart canvas").first).to_be_visible()


@pytest.mark.slow
def test_a_label_is_corrected_by_the_keyboard_and_the_store_has_it(
    page: Page, demo: DemoCell
) -> None:
    with demo.store() as store:
        good = HistoryFilter(label="good")
        (labelled,) = store.decisions.select(good, 1, newest=False)
    opened(page, demo, f"part?id={labelled.decision.id}")
    button, name = page.get_by_role("button", name="It was bad"), page.get_by_label("Your name")
    button.focus()
    for key in ("Escape", "Enter"):
        page.keyboard.press("Enter")
        expect(name).to_be_focused()
        page.keyboard.press(key)
        if key == "Escape":
            expect(button).to_be_focused()
    expect(page.get_by_role("dialog")).to_be_visible()  # without a name nothing is done
    page.keyboard.type(AUTHOR)
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_be_hidden(timeout=PATIENT)
    expect(page.locator("#result")).to_contain_text("counts as a failure, was a success")
    story = f"corrected from good to bad by {AUTHOR}"
    expect(page.locator("#part .story")).to_contain_text(story, timeout=PATIENT)
    assert page.title().startswith("Part")  # what was typed stayed text
    with demo.store() as store:
        assert store.decisions.get(labelled.decision.id, trace=False).success is False
        assert store.corrections.after()[-1].author == AUTHOR


@pytest.mark.slow
def test_every_action_is_done_and_recorded(page: Page, demo: DemoCell) -> None:
    with_a_model(page, demo)
    opened(page, demo, "actions")
    begun = "The retrain has begun."
    for _ in range(60):  # the demonstration's own retrains are under way at times
        confirmed(page, "Retrain now", "Robin")
        if page.locator("#result").text_content() == begun:
            break
        page.wait_for_timeout(500)
    expect(page.locator("#result")).to_have_text(begun)
    confirmed(page, "Roll back")
    confirmed(page, "Release the version")
    with demo.store() as store:
        done = {event.kind for event in store.events.newest(20) if event.author == "Robin"}
    assert done == {"retrain", "rollback", "release"}


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_rules_of_axe_pass_and_a_phone_need_not_scroll_sideways(
    browser: Browser, demo: DemoCell, scheme: str
) -> None:
    with looking(browser, color_scheme=scheme, **PHONE) as page:
        with_a_model(page, demo)
        part = page.locator("a.mark").first.get_attribute("href").removeprefix("/")
        for view in (*VIEWS, part, part.replace("map", "part")):
            opened(page, demo, view)
            must_suit_a_phone(page, view)
        opened(page, demo, "actions")
        page.get_by_role("button", name="Change the policy").click()
        must_suit_a_phone(page, "the policy")


def test_a_dialog_offers_what_there_is_now_and_not_when_the_page_was_opened(
    browser: Browser, tmp_path: Path, stream: Dataset
) -> None:
    def offered() -> list[str | None]:
        page.get_by_role("button", name="Roll back").click()
        choices = page.get_by_label("Version").locator("option").all()
        values = [choice.get_attribute("value") for choice in choices]
        page.get_by_role("button", name="Cancel").click()
        return values

    with cell(tmp_path / "cell.db") as (service, demo), looking(browser) as page:
        played(service, stream, 40)
        service.submit(DataEngine.retrain).result()
        opened(page, demo, "actions")
        expect(page.get_by_role("button", name="Roll back")).to_be_enabled()
        for _ in range(2 * KEEP):  # those that were there at first are kept no longer
            service.submit(DataEngine.retrain).result()
        versions = service.submit(lambda engine: engine.store.versions.all()).result()
        kept = [str(version.report.version) for version in versions if version.kept][-2::-1]
        for _ in range(100):  # the page follows within a moment
            if offered() == kept:
                break
            page.wait_for_timeout(100)
        assert offered() == kept
        confirmed(page, "Roll back", "Robin")
        expect(page.locator("#result")).to_contain_text(f"Version {kept[0]} answers again")


TOKEN = "correct-horse-battery-staple"
STRANGE = "<img src=x onerror=alert(1)> 7"


def played(service: CellService, data: Dataset, n: int = 70) -> Decision:
    """The newest accepted one of n parts with strange numbers, of which nothing is heard."""

    async def play() -> Decision:
        newest = None
        for i in range(n):
            decision = (await service.decide(data.X[i], f"order-{i}", f"{STRANGE}-{i}")).decision
            if decision.action is Action.ACCEPT:
                newest = decision
            elif decision.action is Action.VERIFY:
                await service.report(decision.id, bool(data.y[i]))
        return newest

    with ThreadPoolExecutor(1) as thread:  # in this one Playwright's own loop runs
        return thread.submit(asyncio.run, play()).result()


def test_an_operators_day(browser: Browser, tmp_path: Path, stream: Dataset) -> None:
    viewer, kim = Token("a-viewer-s-password", False, "Line display"), Token(TOKEN, True, "Kim")
    trace = TraceSpec(60, rate_hz=500.0)  # which limits in seconds need
    with cell(tmp_path / "cell.db", (viewer, kim), trace) as (service, demo):
        part = played(service, stream).part
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
            for nothing in ("part?id=nobody", "history?action=nonsense"):
                opened(page, demo, nothing)
                expect(page.locator("h1")).to_have_text("That cannot be shown")
    with demo.store() as store:
        answers = [(event.kind, event.author) for event in store.events.newest(4)]
    kinds = ("report", "policy", "policy", "policy")
    assert answers == [(kind, "Kim") for kind in kinds]  # nobody typed a name


def a_day(page: Page, demo: DemoCell, part: str, file: Path) -> None:
    """A part that came back is found by its number, reported, and looked at; the cell verifies all
    for a while.
    """

    def shown(selector: str, text: Any) -> None:
        expect(page.locator(selector)).to_contain_text(text, timeout=PATIENT)

    opened(page, demo, "history")
    expect(page.locator("#history tbody tr")).to_have_count(50)
    page.get_by_role("link", name="Older").click()
    expect(page.get_by_role("link", name="Newest")).to_be_visible()
    opened(page, demo, "history?action=accept")
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
    shown("h1", f"Part {part}")
    shown("#part .why", "The part turned out bad (stop)")
    opened(page, demo, "actions")
    confirmed(page, "Verify everything")
    shown("#banner", "every part is verified")
    opened(page, demo, "overview")
    shown("#would", re.compile(r"Predicted in shadow mode\s*0 of \d\d verified parts"))
    opened(page, demo, "actions")
    confirmed(page, "Let the model decide again")
    shown("#mode", "Decides")
    page.get_by_role("button", name="Change the policy").click()
    page.get_by_label("Force limits").fill("0.01:0.05::30:reject")
    page.get_by_role("button", name="Do it").click()
    opened(page, demo, "overview?by=hour")
    page.locator("#escapes").get_by_role("link", name=part).click()
    shown("#part figcaption", "the operator's limits are at most 30.0, else reject")
    opened(page, demo, "history?label=bad")
    downloaded(page, "Download these as CSV", file)
    rows = csv.DictReader(file.read_text(encoding="utf-8").splitlines())
    (row,) = (row for row in rows if row["part"] == part)
    assert datetime.fromisoformat(row["time"]) < datetime.fromisoformat(row["label_time"])


def test_dark_is_dark_and_programs_find_the_document(page: Page, demo: DemoCell) -> None:
    opened(page, demo, "history")
    page.get_by_role("button", name="Dark").click()
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(16, 21, 26)"
    page.get_by_role("link", name="for programs").click()
    for text in ("POST /decide", "GET /explanations/{id}", "PolicyRequest"):
        expect(page.locator("main").get_by_text(text, exact=True).first).to_be_visible()


def test_each_channel_is_drawn_in_its_own_unit_and_is_no_force_for_being_drawn(
    browser: Browser, tmp_path: Path, stream: Dataset
) -> None:
    spec = TraceSpec(60, channels=2, unit=("kN", "mm"), columns=("FZ", "SZ"))
    data = Dataset(np.stack([stream.X, stream.X[::-1]], axis=1), stream.y)
    with cell(tmp_path / "cell.db", trace=spec) as (service, demo), looking(browser) as page:
        played(service, data, 40)
        opened(page, demo)
        expect(page.locator("#trace h2")).to_have_text("The trace, and good and bad parts")
        captions = page.locator("#trace figcaption")
        for i, text in enumerate((r"FZ over .* kN\. ", r"SZ over .* mm\. ")):
            expect(captions.nth(i)).to_contain_text(re.compile(text))
        must_be_above_the_fold(page)


def must_be_above_the_fold(page: Page) -> None:
    """Of a screen of 1280 x 720, as the fixture has it: every figure is seen whole without
    scrolling.
    """
    boxes = [
        page.locator(f"#{name}").bounding_box()
        for name in ("verified", "accepted", "bad", "pace", "saved")
    ]
    assert max(box["y"] + box["height"] for box in boxes) <= 720


def test_the_key_figures_are_above_the_fold_and_the_magnifier_stands_for_verify_alone(
    page: Page, demo: DemoCell
) -> None:
    with_a_model(page, demo)
    opened(page, demo)
    must_be_above_the_fold(page)
    shapes = {
        name: page.locator(f"{name} path").first.get_attribute("d")
        for name in (".recent .verify", "#bad .verdict.open")
    }
    assert len(set(shapes.values())) == 2
    expect(page.locator(".decision .came")).to_have_text(
        re.compile("It was good|It was bad|No result reported yet")
    )


@pytest.mark.slow
def test_a_page_that_is_cut_off_says_so_and_comes_back(browser: Browser) -> None:
    with a_service() as service, looking(browser) as page:
        with served(create_app(service)) as port:
            page.goto(f"http://127.0.0.1:{port}/")
            expect(page.locator("#link")).to_have_attribute("data-state", "live", timeout=PATIENT)
        expect(page.locator("#cut")).to_contain_text("What you see is old", timeout=PATIENT)
        with served(create_app(service), port):
            expect(page.locator("#link")).to_have_attribute("data-state", "live", timeout=PATIENT)
            expect(page.locator("#cut")).to_be_hidden()


def signed_in(token: Token) -> dict[str, str]:
    return {"username": "anybody", "password": token.secret}


def downloaded(page: Page, button: str, file: Path) -> Path:
    """The file that a button brings."""
    with page.expect_download() as download:
        page.get_by_role("button", name=button).click()
    download.value.save_as(file)
    return file
