"""The live page in a real browser, over a demonstration as `dengine serve --demo` runs it."""

import asyncio
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from zipfile import ZipFile

import pytest

from dengine import Action, DataEngine, Dataset, Policy, load_exported
from dengine.recipe import Recipe
from dengine.store.sql import SqlStore
from dengine.store.views import HistoryFilter
from tests.support.serving import served

REQUIRED = os.environ.get("DENGINE_REQUIRE_BROWSER") == "1"
CHROMIUM = shutil.which("chromium")


def missing(what: str) -> None:
    if REQUIRED:
        pytest.fail(f"the page's tests need {what}")
    pytest.skip(f"the page's tests need {what}", allow_module_level=True)


if CHROMIUM is None:
    missing("Debian's chromium")
try:
    import uvicorn  # noqa: F401
    from axe_playwright_python.sync_playwright import Axe
    from playwright.sync_api import Browser, Error, Page, expect, sync_playwright

    from dengine.serve.auth import Access
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


def started(command: list[str], folder: Path) -> tuple[subprocess.Popen, str]:
    log = folder / "demo.log"
    with log.open("w") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
    end = time.monotonic() + 120
    while time.monotonic() < end and process.poll() is None:
        found = re.search(r"http://127\.0\.0\.1:\d+", log.read_text())
        if found:
            return process, found.group()
        time.sleep(0.1)
    process.kill()
    raise AssertionError(log.read_text())


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DemoCell]:
    folder = tmp_path_factory.mktemp("demo")
    options = ["--port", "0", "--store", str(folder / "cell.db")]
    process, url = started([sys.executable, "-m", "dengine", "serve", "--demo", *options], folder)
    yield DemoCell(url, folder / "cell.db")
    process.send_signal(2)
    try:
        process.wait(60)
    finally:
        process.kill()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:  # each launch has a new folder for its profile
        browser = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=list(FLAGS))
        yield browser
        browser.close()


@dataclass(frozen=True)
class Watched:
    """A page, what it asked for, and what it complained of."""

    page: Page
    asked: list[str]
    complaints: list[str]


@pytest.fixture
def watched(browser: Browser, demo: DemoCell) -> Iterator[Watched]:
    context = browser.new_context(viewport={"width": 1280, "height": 720}, locale="en-GB")
    context.set_default_timeout(PATIENT)
    page, asked, complaints = context.new_page(), list[str](), list[str]()
    context.on("request", lambda request: asked.append(request.url))
    page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    yield Watched(page, asked, complaints)
    context.close()
    assert complaints == []
    assert [url for url in asked if not url.startswith((demo.url, "blob:" + demo.url))] == []


def opened(page: Page, demo: DemoCell, view: str = "") -> None:
    page.goto(f"{demo.url}/{view}")
    expect(page.locator("#link")).to_have_attribute("data-state", "live", timeout=PATIENT)
    expect(page.locator("h1")).to_be_attached(timeout=PATIENT)  # of the view, once the server has answered


def with_a_model(page: Page, demo: DemoCell) -> None:
    opened(page, demo, "map")
    expect(page.locator("a.mark.good").first).to_be_attached(timeout=PATIENT)


def confirmed(page: Page, button: str, author: str) -> None:
    page.get_by_role("button", name=button).click()
    page.get_by_label("Your name").fill(author)
    page.get_by_role("button", name="Do it").click()
    expect(page.get_by_role("dialog")).to_be_hidden(timeout=PATIENT)


def test_a_decision_appears_and_the_next_one_takes_its_place(watched: Watched, demo: DemoCell) -> None:
    page = watched.page
    opened(page, demo)
    expect(page.locator("#decision")).to_have_text(re.compile("Accept|Reject|Verify"), timeout=PATIENT)
    expect(page.locator("#trace .chart canvas")).to_be_visible()
    expect(page.locator("#trace figcaption")).to_contain_text("Force over 2.0 s")  # what the picture says, in words
    was = page.locator(".decision .about").inner_text()
    expect(page.locator(".decision .about")).not_to_have_text(was, timeout=PATIENT)
    assert page.evaluate("performance.getEntriesByType('navigation').length") == 1  # it was told, and never loaded again


@pytest.mark.slow
def test_a_part_on_the_map_is_clicked_and_shows_its_trace(watched: Watched, demo: DemoCell) -> None:
    page = watched.page
    with_a_model(page, demo)
    mark = page.locator("a.mark").first
    name = mark.get_attribute("aria-label").split(",")[0]
    mark.dispatch_event("click")  # marks lie over each other: whichever is on top would be hit
    expect(page.locator("#part-title")).to_have_text(f"Part {name}", timeout=PATIENT)
    expect(page.locator("#part-title")).to_be_focused()
    expect(page.locator("#part .chart canvas")).to_be_visible()
    expect(page.locator("#part .story li").first).to_contain_text("Verify")
    page.locator("a.mark.newest").click()  # the newest is drawn last, and hit by the mouse
    expect(page.locator("#part-title")).not_to_have_text(f"Part {name}", timeout=PATIENT)


@pytest.mark.slow
def test_the_map_is_gone_over_by_the_keyboard_alone(watched: Watched, demo: DemoCell) -> None:
    page = watched.page
    with_a_model(page, demo)
    page.locator(".skip").focus()
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.matches('a.mark')"):
            break
    first = page.evaluate("document.activeElement.id")
    for key in ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"):
        page.keyboard.press(key)
        if page.evaluate("document.activeElement.id") != first:
            break
    assert page.evaluate("document.activeElement.matches('a.mark')")
    assert page.evaluate("document.activeElement.id") != first
    page.keyboard.press("Enter")
    expect(page.locator("#part-title")).to_be_focused(timeout=PATIENT)
    expect(page.locator("#part .chart canvas").first).to_be_visible()


@pytest.mark.slow
def test_a_label_is_corrected_by_the_keyboard_and_the_store_has_it(watched: Watched, demo: DemoCell) -> None:
    page = watched.page
    with demo.store() as store:
        labelled = next(past for past in store.decisions(HistoryFilter(label="good"), 1, newest=False))
    opened(page, demo, f"part?id={labelled.decision.id}")
    page.get_by_role("button", name="It was bad").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_label("Your name")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.get_by_role("button", name="It was bad")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.get_by_label("Your name")).to_be_focused()
    page.keyboard.press("Enter")  # without a name nothing is done
    expect(page.get_by_role("dialog")).to_be_visible()
    page.keyboard.type(AUTHOR)
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_be_hidden(timeout=PATIENT)
    expect(page.locator("#said")).to_contain_text("counts as a failure, was a success")
    expect(page.locator("#part .story")).to_contain_text(f"corrected from good to bad by {AUTHOR}", timeout=PATIENT)
    assert page.title().startswith("Part")  # what was typed stayed text
    with demo.store() as store:
        assert store.get_decision(labelled.decision.id, trace=False).success is False
        assert store.corrections()[-1].author == AUTHOR


@pytest.mark.slow
def test_every_action_is_done_and_recorded(watched: Watched, demo: DemoCell, tmp_path: Path) -> None:
    page = watched.page
    with_a_model(page, demo)
    opened(page, demo, "actions")
    confirmed(page, "Verify everything", "Robin")
    expect(page.locator("#mode")).to_contain_text("Verifying all", timeout=PATIENT)
    expect(page.locator("#banner")).to_contain_text("every part is verified")
    page.get_by_role("button", name="Let the model decide again").click()
    expect(page.get_by_label("Your name")).to_have_value("Robin")  # it is remembered
    page.get_by_role("button", name="Do it").click()
    expect(page.locator("#mode")).to_contain_text("Decides", timeout=PATIENT)
    confirmed(page, "Retrain now", "Robin")
    confirmed(page, "Roll back", "Robin")
    page.get_by_role("button", name="Export").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="Do it").click()
    download.value.save_as(tmp_path / "model.zip")
    with ZipFile(tmp_path / "model.zip") as archive:
        archive.extractall(tmp_path)
    with demo.store() as store:
        done = {event.kind for event in store.events(20) if event.author == "Robin"}
        trace = store.get_decision(store.decisions(HistoryFilter(), 1)[0].decision.id).trace
    assert done == {"shadow", "retrain", "rollback", "export"}
    assert load_exported(tmp_path / "model.ts").decide(trace).action in Action


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_rules_of_axe_pass_and_a_phone_need_not_scroll_sideways(browser: Browser, demo: DemoCell, scheme: str) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 844}, color_scheme=scheme, locale="en-GB")
    context.set_default_timeout(PATIENT)
    page = context.new_page()
    with_a_model(page, demo)
    part = page.locator("a.mark").first.get_attribute("href").removeprefix("/")
    for view in (*VIEWS, part, part.replace("map", "part")):
        opened(page, demo, view)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390, view
        found = Axe().run(page)
        assert found.violations_count == 0, f"{view}: {found.generate_report()}"
    opened(page, demo, "actions")
    page.get_by_role("button", name="Change the policy").click()
    found = Axe().run(page)
    assert found.violations_count == 0, found.generate_report()
    context.close()


TOKEN = "correct-horse-battery-staple"
STRANGE = "<img src=x onerror=alert(1)> 7"


def accepted_part(service: CellService, data: Dataset, n: int = 70) -> str:
    """n parts with strange numbers; the number of the newest one that was accepted."""

    async def cell() -> str:
        accepted = ""
        for i in range(n):
            decision = (await service.decide(data.X[i], f"order-{i}", f"{STRANGE}-{i}")).decision
            if decision.action is Action.ACCEPT:
                accepted = str(decision.part)
            if decision.action is Action.VERIFY:
                await service.report(decision.id, bool(data.y[i]))
        return accepted

    with ThreadPoolExecutor(1) as thread:  # in this one Playwright's own loop runs
        return thread.submit(asyncio.run, cell()).result()


@contextmanager
def behind_a_token(browser: Browser, file: Path, data: Dataset) -> Iterator[tuple[Page, DemoCell, str]]:
    """A page that somebody has logged in to, its cell, and the number of a part that was accepted."""
    recipe = Recipe("pca", radius=0.5, retrain_every=40, policy=Policy(alpha=0.1, lower_bound=0.9))
    service = CellService(lambda: DataEngine.open_or_create(file, recipe=recipe), file, deadline=60.0)
    with closing(service), served(create_app(service, Access(TOKEN, rate=0.0))) as port:
        part = accepted_part(service, data)
        context = browser.new_context(http_credentials={"username": "kim", "password": TOKEN}, locale="en-GB")
        context.set_default_timeout(PATIENT)
        page, alerts = context.new_page(), list[str]()
        page.on("dialog", lambda dialog: alerts.append(dialog.message))
        yield page, DemoCell(f"http://127.0.0.1:{port}", file), part
        context.close()
        assert alerts == []  # strange numbers stayed text


def test_an_operator_logs_in_reports_a_part_that_came_back_and_looks_at_why(
    browser: Browser, tmp_path: Path, make_data: Callable[..., Dataset]
) -> None:
    with behind_a_token(browser, tmp_path / "cell.db", make_data(200, samples=60, seed=3)) as (page, demo, part):
        stranger = browser.new_context()
        with pytest.raises(Error, match="ERR_INVALID_AUTH_CREDENTIALS"):  # the browser knows that it may ask for a password
            stranger.new_page().goto(demo.url)
        stranger.close()
        opened(page, demo, "actions")
        page.get_by_role("button", name="This accepted part was bad").click()
        page.get_by_label("Its number").fill(part)
        page.get_by_label("Your name").fill("Kim")
        page.get_by_role("button", name="Do it").click()
        expect(page.locator("#said")).to_have_text("It is recorded: bad.", timeout=PATIENT)
        opened(page, demo, "overview")
        expect(page.locator("#saved")).to_contain_text("system stops, not taken off: 1")
        expect(page.locator("#events")).to_contain_text("Kim")
        page.locator("#escapes").get_by_role("link", name=part).click()
        expect(page.locator("h1")).to_have_text(f"Part {part}")
        expect(page.locator("#part .why")).to_contain_text("The part turned out bad (stop)")
        opened(page, demo, "actions")
        confirmed(page, "Verify everything", "Kim")
        expect(page.locator("#banner")).to_contain_text("every part is verified", timeout=PATIENT)
        opened(page, demo, "overview")
        expect(page.locator("#would")).to_contain_text("It would have decided")


def test_the_history_is_searched_gone_through_and_taken_along(
    browser: Browser, tmp_path: Path, make_data: Callable[..., Dataset]
) -> None:
    with behind_a_token(browser, tmp_path / "cell.db", make_data(200, samples=60, seed=3)) as (page, demo, part):
        opened(page, demo, "history")
        expect(page.locator("#history tbody tr")).to_have_count(50)
        page.get_by_role("link", name="Older").click()
        expect(page.get_by_role("link", name="Newest")).to_be_visible()
        opened(page, demo, "history?action=accept")
        page.get_by_label("Part's number").fill(part)
        page.get_by_role("button", name="Show").click()
        expect(page.locator("#history tbody tr")).to_have_count(1)
        with page.expect_download() as download:
            page.get_by_role("button", name="Download these as CSV").click()
        download.value.save_as(tmp_path / "list.csv")
        assert part in (tmp_path / "list.csv").read_text(encoding="utf-8")
        page.get_by_role("button", name="Dark").click()
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(16, 21, 26)"
        opened(page, demo, "part?id=nobody")
        expect(page.locator("h1")).to_have_text("That cannot be shown")
        page.get_by_role("link", name="for programs").click()  # the document of the API, to read
        for text in ("POST /decide", "GET /explanations/{id}", "PolicyChange"):
            expect(page.locator("main").get_by_text(text, exact=True).first).to_be_visible()


def stopped_until_safe(service: CellService, data: Dataset) -> str:
    """Parts, until accepted ones that are said to have stopped the line bring on the safe mode; the id of the last."""

    async def cell() -> str:
        for i in range(len(data)):
            decision = (await service.decide(data.X[i], f"part-{i}")).decision
            if decision.action is Action.REJECT:
                continue
            accepted = decision.action is Action.ACCEPT
            broken = accepted and i >= 120  # the line's own sensor
            await service.report(decision.id, bool(data.y[i]) and not broken)
            if accepted and service.engine.safe_mode:
                return decision.id
        raise AssertionError("no safe mode")

    with ThreadPoolExecutor(1) as thread:  # in this one Playwright's own loop runs
        return thread.submit(asyncio.run, cell()).result()


@pytest.mark.slow
def test_a_safe_mode_that_the_engine_enters_is_shown_and_ends_when_what_was_wrong_is_put_right(
    browser: Browser, tmp_path: Path, make_data: Callable[..., Dataset]
) -> None:
    recipe = Recipe("pca", radius=0.5, retrain_every=40, policy=Policy(alpha=0.1, lower_bound=0.9, stops="all"))
    file, data = tmp_path / "cell.db", make_data(400, samples=60, seed=3)
    service = CellService(lambda: DataEngine.open_or_create(file, recipe=recipe), file, deadline=60.0)
    context = browser.new_context(viewport={"width": 390, "height": 844}, locale="en-GB")
    context.set_default_timeout(PATIENT)
    page = context.new_page()
    with closing(service), served(create_app(service)) as port:
        demo = DemoCell(f"http://127.0.0.1:{port}", file)
        opened(page, demo)
        last = stopped_until_safe(service, data)  # while somebody looks on
        expect(page.locator("#mode")).to_contain_text("Safe mode", timeout=PATIENT)
        expect(page.locator("#banner")).to_contain_text("(accepted parts failed more often than the tolerance)")
        for view in VIEWS:
            opened(page, demo, view)
            expect(page.locator("#mode")).to_contain_text("Safe mode")
            expect(page.locator("#banner")).to_contain_text("every part is verified")
            assert page.evaluate("document.documentElement.scrollWidth") <= 390, view
            found = Axe().run(page)
            assert found.violations_count == 0, f"{view}: {found.generate_report()}"
        opened(page, demo, f"part?id={last}")
        confirmed(page, "It was good", "Kim")
        expect(page.locator("#banner")).to_be_empty(timeout=PATIENT)
        expect(page.locator("#mode")).to_contain_text("Decides")
        context.close()
    with demo.store() as store:
        told = [(event.kind, event.author, event.text) for event in store.events(3)]
    assert [each[:2] for each in told] == [("safe mode", ""), ("correct", "Kim"), ("safe mode ended", "")]
    assert told[0][2] == "accepted parts failed more often than the tolerance"
    assert last in told[1][2]
    assert told[2][2] == "what was told anew keeps the tolerance"


@pytest.mark.slow
def test_a_page_that_is_cut_off_says_so_and_comes_back(browser: Browser) -> None:
    service = CellService(lambda: DataEngine("pca"))
    context = browser.new_context(locale="en")
    context.set_default_timeout(PATIENT)
    page = context.new_page()
    with served(create_app(service)) as port:
        page.goto(f"http://127.0.0.1:{port}/")
        expect(page.locator("#link")).to_have_attribute("data-state", "live", timeout=PATIENT)
    expect(page.locator("#cut")).to_contain_text("What you see is old", timeout=PATIENT)
    with served(create_app(service), port):
        expect(page.locator("#link")).to_have_attribute("data-state", "live", timeout=PATIENT)
        expect(page.locator("#cut")).to_be_hidden()
        context.close()
    service.close()
