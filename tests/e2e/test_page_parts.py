"""The page without a browser: words, pictures, what is shown of strange names, and which acts are refused."""

import asyncio
import re
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

pytest.importorskip("sse_starlette", reason="the page needs the extra `serve`")
pytest.importorskip("httpx", reason="Starlette's test client needs httpx")

from starlette.testclient import TestClient

from dengine import DataEngine, Dataset, Policy, Recipe
from dengine.records import Action, Reason, Source
from dengine.serve.auth import Access
from dengine.serve.http import create_app
from dengine.serve.page.charts import Scale, element, number, percent
from dengine.serve.page.looking import ChangeFeed, Looking
from dengine.serve.page.views import SOURCE, WORDS, duration
from dengine.serve.service import CellService
from dengine.store.views import HistoryFilter

RECIPE = Recipe("pca", radius=0.5, retrain_every=30, policy=Policy(alpha=0.1, lower_bound=0.9))
STRANGE = "<script>alert('part')</script>"
VIEWS = ("/", "/how", "/map", "/history", "/acts")


@pytest.fixture(scope="module")
def stream(make_data) -> Dataset:
    return make_data(80, samples=60, seed=3)


@pytest.fixture
def service(make_service: Callable[[Recipe], CellService]) -> CellService:
    return make_service(RECIPE)


@pytest.fixture
def client(service: CellService) -> Iterator[TestClient]:
    app = create_app(service, interfaces=("page",))
    with TestClient(app, "http://localhost", headers={"origin": "http://localhost"}) as client:
        yield client


def cell_runs(service: CellService, stream: Dataset, n: int) -> None:
    async def cell() -> None:
        for i in range(n):
            answer = await service.decide(stream.X[i], f"order-{i}", f"{STRANGE}{i}")
            if answer.decision.action is Action.VERIFY:
                await service.report(answer.decision.id, bool(stream.y[i]))

    asyncio.run(cell())
    service.reading.flush()


def token(client: TestClient) -> str:
    return re.search('data-token="([^"]+)"', client.get("/acts").text).group(1)


def act(client: TestClient, name: str, **form: str) -> tuple[int, str]:
    answer = client.post(f"/acts/{name}", data={"token": token(client), "author": "Kim"} | form)
    return answer.status_code, answer.json()["said"]


def test_every_reason_action_and_source_has_its_words_and_numbers_are_written_to_be_read() -> None:
    assert {f"reason.{each.value}" for each in Reason} | {f"action.{each.value}" for each in Action} <= set(WORDS)
    assert set(SOURCE) == set(Source)
    assert (number(1234.56, 1), number(-0.04, 1), number(-2.0), number(None)) == ("1,234.6", "0.0", "−2", "–")
    assert (percent(0.125, 1), duration(90), duration(9000)) == ("12.5\u202f%", "90 s", "2.5 h")


def test_a_picture_escapes_what_goes_into_it_and_its_scales_stay_in_it_with_round_ticks() -> None:
    assert "<script>" not in element("text", STRANGE, aria_label='"><script>')
    scale = Scale(-3.0, 7.0, 100.0, 0.0)
    assert (scale.at(-100.0), scale.at(100.0)) == (100.0, 0.0)
    assert scale.all(np.array([np.nan, np.inf, -np.inf, 2.0])).tolist() == [100.0, 0.0, 100.0, 50.0]
    assert scale.ticks(5) == [-2.0, 0.0, 2.0, 4.0, 6.0]
    assert Scale(1.0, 1.0, 0.0, 9.0).ticks() == [1.0]


@pytest.mark.parametrize("n", [0, 70])
def test_every_view_is_shown_before_the_first_part_and_after_many(
    client: TestClient, service: CellService, stream: Dataset, n: int
) -> None:
    cell_runs(service, stream, n)
    for view in VIEWS:
        answer = client.get(view)
        assert answer.status_code == 200
        assert "script-src 'self'" in answer.headers["content-security-policy"]
    for unknown in ("/part?id=nobody", "/part", "/static/../views.py", "/page/static/%2e%2e/views.py"):
        assert client.get(unknown).status_code == 404
    assert client.get("/map?id=nobody").status_code == 200


def test_strange_names_stay_text_wherever_they_are_shown(client: TestClient, service: CellService, stream: Dataset) -> None:
    cell_runs(service, stream, 70)
    first = service.reading.past_decision("order-0")
    opposite = "bad" if first.success else "good"
    assert act(client, "correct", id="order-0", label=opposite, author=STRANGE)[0] == 200
    shown = [client.get(view).text for view in (*VIEWS, "/part?id=order-0", "/map?id=order-0", f"/part?id={STRANGE}")]
    assert all("<script>alert" not in text for text in shown)
    assert "&lt;script&gt;alert" in shown[0]
    assert f"corrected from {first.label} to {opposite} by &lt;script&gt;" in shown[5]


def test_stops_stand_beside_the_time_that_they_are_not_taken_off(
    client: TestClient, service: CellService, stream: Dataset
) -> None:
    cell_runs(service, stream, 70)
    (accepted,) = service.reading.decisions(HistoryFilter(action=Action.ACCEPT), 1)
    asyncio.run(service.report(accepted.decision.id, False))
    service.reading.flush()
    for view in ("/", "/how"):
        assert "s each; system stops, not taken off: 1</p>" in client.get(view).text


def test_the_history_is_filtered_and_its_older_pages_follow_one_another(
    client: TestClient, service: CellService, stream: Dataset
) -> None:
    cell_runs(service, stream, 70)
    first = client.get("/history").text
    older = re.search(r'rel="next" href="([^"]+)"', first).group(1).replace("&amp;", "&")
    second = client.get(older).text
    ids = [re.findall(r'<td><a href="/part\?id=([^"]+)"', page) for page in (first, second)]
    assert [len(each) for each in ids] == [50, 20]
    assert len({*ids[0], *ids[1]}) == 70
    assert set(re.findall(r'<span class="label (\w+)">', client.get("/history?label=bad&reason=dance").text)) == {"bad"}


def test_an_act_without_the_pages_token_its_origin_or_a_name_is_refused(client: TestClient, service: CellService) -> None:
    good = {"token": token(client), "author": "Kim"}
    for status, change, headers in (
        (403, {"token": "guess"}, {}),
        (403, {"token": ""}, {}),
        (403, {}, {"origin": "http://elsewhere"}),
        (403, {}, {"sec-fetch-site": "cross-site"}),
        (422, {"author": "  "}, {}),
        (422, {"author": "x" * 200}, {}),
        (413, {"more": "x" * 10_000}, {}),
    ):
        assert client.post("/acts/shadow-on", data=good | change, headers=headers).status_code == status, (change, headers)
    assert client.post("/acts/dance", data=good).status_code == 404
    assert client.get("/acts/shadow-on").status_code == 405
    del client.headers["origin"]  # a program that is no browser sends none, and is not the page
    assert client.post("/acts/shadow-on", data=good).status_code == 403
    with TestClient(create_app(service, Access(largest=100), ("page",)), "http://localhost") as small:
        refused = small.post("/acts/shadow-on", data={"more": "x" * 200}, headers={"origin": "http://localhost"})
    assert (refused.status_code, refused.headers["connection"]) == (413, "close")
    assert "at most 100 bytes" in refused.json()["detail"]  # which the page's script tells
    assert service.reading.events() == []


def test_an_act_that_the_engine_refuses_is_told_with_its_reason(client: TestClient, service: CellService) -> None:
    assert act(client, "correct", id="nobody", label="fine") == (
        409,
        "It was not done: Expected label to be good or bad, got 'fine'.",
    )
    refused = {"correct": {"id": "nobody", "label": "good"}, "rollback": {"version": "7"}, "export": {}}
    assert [act(client, name, **form)[0] for name, form in refused.items()] == [409] * 3
    assert act(client, "rollback", version="../1")[0] == 409
    assert service.reading.events() == []


def test_an_act_is_done_once_and_says_where_nothing_changed(client: TestClient, service: CellService) -> None:
    assert act(client, "shadow-on") == (200, "Every part is verified from now on.")
    assert act(client, "shadow-on") == (200, "Nothing changed: it was so already.")
    assert "Verifying all" in client.get("/").text
    assert [event.author for event in service.reading.events()] == ["Kim"]


def test_a_retrain_that_is_under_way_is_not_begun_once_more(stream: Dataset) -> None:
    free = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(free.wait, 60)  # what follows waits behind it
        service = CellService(lambda: DataEngine(recipe=RECIPE, executor=pool), deadline=30.0)
        try:
            cell_runs(service, stream, 20)
            with TestClient(create_app(service), "http://localhost", headers={"origin": "http://localhost"}) as client:
                assert act(client, "retrain")[1].startswith("The retrain has begun")
                assert act(client, "retrain")[1].startswith("Nothing changed")
        finally:
            free.set()
            service.close()


def test_a_choice_of_appearance_goes_into_a_cookie_and_back_to_the_view(client: TestClient) -> None:
    answer = client.get("/history?label=bad&theme=light", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/history?label=bad")
    assert "samesite=strict" in answer.headers["set-cookie"].lower()
    assert 'data-theme="dark"' in client.get("/how?theme=dark").text
    assert client.get("/how?theme=pink").status_code == 200


def test_a_view_that_takes_long_rests_and_is_told_of_again(service: CellService, stream: Dataset) -> None:
    looks: list[int] = []

    def slow(looking: Looking) -> int:
        looks.append(looking.feed.number)
        time.sleep(0.02)
        return len(looks)

    async def reader() -> None:
        feed = ChangeFeed(service)
        looking = Looking(service, feed)
        assert await looking.look("view", slow) == 1
        feed.advance()
        changed = feed.number
        assert await looking.look("view", slow) == 1  # what was found before, and whoever watches is told again
        while feed.number == changed:
            await asyncio.sleep(0.01)
        assert await looking.look("view", slow) == 2
        looking.look_anew()
        assert await looking.look("view", slow) == 3  # somebody did something

    asyncio.run(asyncio.wait_for(reader(), 60))
    assert len(set(looks)) == 3
