"""OPC UA by a real client: what a PLC calls, what a SCADA reads, and what strangers get."""

import asyncio
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from dengine.errors import SettingError
from dengine.serve.auth import Token
from dengine.store.views import HistoryFilter
from tests.support.serving import a_service, certificate
from tests.support.tables import rows

pytest.importorskip("asyncua", reason="OPC UA needs the extra `opcua`")
from asyncua import Client, ua

from dengine.serve import opcua

pytestmark = pytest.mark.anyio
VERIFY, ACCEPT = 0, 1
TOKENS = Token("s3cret"), Token("viewer", operates=False)
FLOAT, TEXT, COUNT = ua.VariantType.Float, ua.VariantType.String, ua.VariantType.UInt32


def url(server: Any) -> str:
    return f"opc.tcp://127.0.0.1:{server.bserver.port}/dengine"


class Plant:
    """A cell, its OPC UA server, and a PLC that is connected to it."""

    def __init__(self, service, client, index):
        self.service, self.client, self.index = service, client, index

    def node(self, name):
        return self.client.get_node(ua.NodeId(name, self.index))

    async def value(self, name):
        return await self.node(f"Cell.{name}").read_value()

    async def decisions(self):
        await self.service.call(lambda engine: engine.flush())
        return self.service.read_store.decisions.counts()["decisions"]

    async def until(self, name, fits):
        async with asyncio.timeout(60):
            while not fits(value := await self.value(name)):
                await asyncio.sleep(0.05)
        return value

    async def decide(self, trace, request="", part=""):
        samples = ua.Variant(trace.tolist(), FLOAT)
        texts = ua.Variant(request, TEXT), ua.Variant(part, TEXT)
        return await self.call("Decide", samples, ua.Variant(1, COUNT), *texts)

    async def report(self, id_, success):
        return await self.call("Report", ua.Variant(id_, TEXT), ua.Variant(success))

    async def call(self, name, *arguments):
        return await self.node("Cell").call_method(self.node(f"Cell.{name}").nodeid, *arguments)


@pytest.fixture(scope="module")
def anyio_backend():
    return "asyncio"  # as of asyncua, one loop for the module


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    with a_service(tmp_path_factory.mktemp("cell") / "cell.db") as created:
        yield created


@pytest.fixture(scope="module")
async def plant(service, anyio_backend):
    async with opcua.opcua_server(service, port=0) as server, Client(url(server)) as client:
        yield Plant(service, client, await client.get_namespace_index(opcua.NAMESPACE))


async def test_a_plc_decides_and_reports_and_a_scada_sees_it(plant, stream):
    actions = []
    for i, (x, good) in enumerate(zip(stream.X[:120], stream.y, strict=False)):
        action, id_, _, lower, upper, version = await plant.decide(x, f"order-{i}", f"P{i}")
        assert id_ == f"order-{i}"
        assert 0.0 <= lower <= upper <= 1.0
        actions.append(action)
        if action == VERIFY:
            assert await plant.report(id_, bool(good)) is True
    assert ACCEPT in actions
    assert await plant.until("Decisions", lambda n: n == len(actions)) == len(actions)
    assert await plant.value("Accepted") == actions.count(ACCEPT)
    assert await plant.value("ModelVersion") == version >= 1
    assert await plant.value("VerifiedShare") == actions.count(VERIFY) / len(actions)
    assert await plant.report("unheard of", True) is False
    with pytest.raises(ua.uaerrors.BadInvalidArgument):
        await plant.decide(stream.X[1], "order-0")
    assert "got another" in await plant.value("LastRefused")
    match = await plant.service.find("order-7")
    assert (match.decision.part, np.array_equal(match.trace[0], stream.X[7])) == ("P7", True)


UA = "{http://opcfoundation.org/UA/2011/03/UANodeSet.xsd}"
# -1: one value; 1: an array.
METHODS = """
Decide InputArguments Trace Float 1, Channels UInt32 -1, Request String -1, Part String -1
Decide OutputArguments Action Int32 -1, Id String -1, Reason String -1, Lower Double -1, Upper Double -1, ModelVersion UInt32 -1
Report InputArguments Id String -1, Success Boolean -1
Report OutputArguments Kept Boolean -1
"""


async def test_the_variables_and_methods_are_as_the_file_and_the_page_describe_them_and_read_only(
    plant, repo
):
    page = (repo / "docs" / "howto" / "plc_and_robot.md").read_text(encoding="utf-8")
    file = ElementTree.parse(Path(opcua.__file__).with_name("cell.xml"))
    types = {
        item.get("NodeId").removeprefix("ns=1;s=Cell."): item.get("DataType")
        for item in file.iter(f"{UA}UAVariable")
        if item.get("DataType") != "Argument"
    }
    assert set(types) == {*opcua.STATUS_NAMES, "LastRefused"}
    for name, type_ in types.items():
        node = plant.node(f"Cell.{name}")
        assert (await node.read_data_value()).Value.VariantType.name == type_, name
        assert f"| `Cell.{name}` | {type_} | " in page
        with pytest.raises(ua.UaStatusCodeError):
            await node.write_value(await node.read_value())
    with pytest.raises(ua.UaStatusCodeError):
        await plant.client.nodes.objects.add_folder(plant.index, "mine")
    for method, kind, arguments in rows(METHODS, 3):
        node = await plant.node(f"Cell.{method}").get_child(f"0:{kind}")
        described = [
            f"{item.Name} {ua.VariantType(item.DataType.Identifier).name} {item.ValueRank}"
            for item in await node.read_value()
        ]
        assert ", ".join(described) == arguments


@pytest.mark.parametrize("empty", [None, ""])
async def test_the_example_client_plays_a_shift_with_a_controllers_types_and_empty_texts(
    tmp_path, repo, empty
):
    play = runpy.run_path(str(repo / "training" / "opcua_client.py"))["play"]
    with a_service(tmp_path / "cell.db") as service:
        async with opcua.opcua_server(service, port=0) as server:
            counts, *_ = await play(url(server), 60, empty)
            await service.call(lambda engine: engine.flush())
        page = service.read_store.decisions.select(HistoryFilter(), 1000)
    actions = [past.decision.action for past in page]
    n = [f"{actions.count(action)} {action}" for action in ("verify", "accept", "reject")]
    assert (counts, len(actions)) == (", ".join(n), 60)
    # An empty text, or none, is no part's number, nor an id of the caller's.
    assert [past.decision.part for past in page].count(None) == 30
    assert all(len(past.decision.id) > 3 for past in page)


SOUND = {
    "Trace": ua.Variant([1.0] * 60, FLOAT),
    "Channels": ua.Variant(1, COUNT),
    "Request": ua.Variant("", TEXT),
    "Part": ua.Variant("", TEXT),
}
WRONG = [  # an argument, its value and type, and what is said of it
    ("Trace", [1.0] * 60, "Double", "got Double array, UInt32, String, String."),
    ("Trace", None, "Null", "got String, UInt32, String, String."),
    ("Trace", [1.0] * 10, "Float", ""),
    ("Channels", 1, "Int32", "got Float array, Int32, String, String."),
    ("Channels", 2, "UInt32", ""),  # two channels of a cell of one
    ("Channels", 7, "UInt32", "as many samples of each channel, got 60 of 7"),
    ("Request", ["a"], "String", "got Float array, UInt32, String array, String."),
    ("Request", "a\nb", "String", ""),
]


@pytest.mark.parametrize(("name", "value", "kind", "text"), WRONG)
async def test_a_wrong_argument_is_a_bad_status_and_named(plant, name, value, kind, text):
    before = await plant.decisions()
    given = SOUND | {name: ua.Variant(value, ua.VariantType[kind])}
    with pytest.raises(ua.uaerrors.BadInvalidArgument):
        await plant.call("Decide", *given.values())
    refused = await plant.value("LastRefused")
    assert refused.startswith("Expected ")
    assert text in refused
    assert await plant.decisions() == before


async def test_a_label_that_is_no_bool_is_a_bad_status(plant):
    with pytest.raises(ua.uaerrors.BadInvalidArgument):
        await plant.call("Report", ua.Variant("order-1", TEXT), ua.Variant(1, ua.VariantType.Int32))


async def test_an_alarm_is_a_variable_and_an_event(plant, stream, monkeypatch):
    heard: asyncio.Queue[Any] = asyncio.Queue()

    class Listener:
        def event_notification(self, event):
            heard.put_nowait(event)

    subscription = await plant.client.create_subscription(50, Listener())
    await subscription.subscribe_events()
    full = replace(await plant.service.status(), store_fault="disk full")
    monkeypatch.setattr(plant.service, "status", lambda: asyncio.sleep(0, full))
    await plant.decide(stream.X[0])
    assert await plant.until("Alarm", bool)
    event = await asyncio.wait_for(heard.get(), 60)
    assert (event.Severity, event.SourceName) == (opcua.ALARM, "Cell")
    assert event.Message.Text == await plant.value("AlarmText")
    assert event.Message.Text == "The store cannot be written: disk full"


async def test_a_store_that_cannot_be_read_leaves_values_that_say_they_are_old(plant, monkeypatch):
    async def away():
        raise RuntimeError("the store is away")

    decided = await plant.decisions()
    node = plant.node("Cell.Decisions")
    before = await plant.until("Decisions", lambda n: n == decided)
    for stand_in, status in ((away, "UncertainLastUsableValue"), (plant.service.status, "Good")):
        monkeypatch.setattr(plant.service, "status", stand_in)
        async with asyncio.timeout(60):
            while (read := await node.read_data_value(False)).StatusCode.name != status:
                await plant.service.call(lambda engine: None)
                await asyncio.sleep(0.05)
        assert read.Value.Value == before


@pytest.mark.parametrize(
    "options",
    [
        {"host": "0.0.0.0"},
        {"host": "0.0.0.0", "tokens": TOKENS},
        {"host": "0.0.0.0", "cert": "c.pem", "key": "k.pem"},
        {"cert": "c.pem"},
    ],
)
async def test_elsewhere_it_wants_a_token_and_everywhere_a_certificate_with_its_key(
    service, options
):
    with pytest.raises(SettingError, match=r"a certificate and (a|its) key"):
        async with opcua.opcua_server(service, port=0, **options):
            raise AssertionError("it must not be served")


async def test_with_a_certificate_only_who_encrypts_and_knows_the_token_gets_in(
    service, tmp_path, monkeypatch
):
    certificate(tmp_path, "URI:urn:dengine:server")
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"

    async def connect(user, password, security):
        client = Client(url(server))
        client.application_uri = "urn:dengine:server"
        if security:
            await client.set_security_string(security)
        client.set_user(user)
        client.set_password(password)
        async with client:
            index = await client.get_namespace_index(opcua.NAMESPACE)
            return await client.get_node(ua.NodeId("Cell.ModelVersion", index)).read_value()

    async with opcua.opcua_server(service, 0, "127.0.0.1", TOKENS, cert, key) as server:
        encrypted = f"Basic256Sha256,SignAndEncrypt,{cert},{key}"
        assert await connect("dengine", "s3cret", encrypted) == service.engine.version
        for user, password in (
            ("dengine", "wrong"),
            ("admin", "s3cret"),
            ("", ""),
            ("dengine", "viewer"),
        ):
            with pytest.raises((ua.UaError, ConnectionError, TimeoutError)):
                await connect(user, password, encrypted)
        # A client that does not care for what the server's endpoints are gets no session either.
        monkeypatch.setattr(
            Client, "find_endpoint", staticmethod(lambda endpoints, *wanted: endpoints[0])
        )
        with pytest.raises(ua.uaerrors.BadUserAccessDenied):
            await connect("dengine", "s3cret", "")
