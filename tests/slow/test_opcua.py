"""OPC UA by a real client: what a PLC calls, what a SCADA reads, and what strangers get."""

import asyncio
import runpy
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from dengine import Dataset, Recipe
from dengine.errors import SettingError
from dengine.serve.service import CellService
from dengine.store.views import HistoryFilter
from tests.support.serving import a_service, certificate

pytest.importorskip("asyncua", reason="OPC UA needs the extra `opcua`")
Client, ua = (getattr(pytest.importorskip("asyncua"), name) for name in ("Client", "ua"))
opcua = pytest.importorskip("dengine.serve.opcua")

pytestmark = pytest.mark.anyio
VERIFY, ACCEPT = 0, 1
FLOAT, TEXT, COUNT = ua.VariantType.Float, ua.VariantType.String, ua.VariantType.UInt32


class Plant:
    """A cell, its OPC UA server, and a PLC that is connected to it."""

    def __init__(self, service: CellService, client: Any, index: int) -> None:
        self.service, self.client, self.index = service, client, index
        self.cell = self.node("Cell")

    def node(self, name: str) -> Any:
        return self.client.get_node(ua.NodeId(name, self.index))

    async def value(self, name: str) -> Any:
        return (await self.read(name)).Value.Value

    async def read(self, name: str) -> Any:
        return await self.node(f"Cell.{name}").read_data_value(raise_on_bad_status=False)

    async def decisions(self) -> int:
        await self.service.call(lambda engine: engine.flush())
        return self.service.read_store.decisions.counts()["decisions"]

    async def until(self, name: str, fits: Callable[[Any], bool]) -> Any:
        async with asyncio.timeout(60):
            while not fits(value := await self.value(name)):
                await asyncio.sleep(0.05)
        return value

    async def decide(
        self, trace: np.ndarray, request: str = "", part: str = "", channels: int = 1
    ) -> list[Any]:
        arguments = (
            (trace.ravel().tolist(), FLOAT),
            (channels, COUNT),
            (request, TEXT),
            (part, TEXT),
        )
        return await self.call("Decide", *(ua.Variant(*argument) for argument in arguments))

    async def report(self, id_: str, success: bool) -> bool:
        return await self.call("Report", ua.Variant(id_, TEXT), ua.Variant(success))

    async def call(self, name: str, *arguments: Any) -> Any:
        return await self.cell.call_method(self.node(f"Cell.{name}").nodeid, *arguments)


@pytest.fixture(scope="module")
def anyio_backend() -> str:
    return "asyncio"  # as of asyncua, one loop for the module


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CellService]:
    with a_service(tmp_path_factory.mktemp("cell") / "cell.db") as created:
        yield created


@pytest.fixture(scope="module")
async def plant(service: CellService, anyio_backend: str) -> AsyncIterator[Plant]:
    async with (
        opcua.opcua_server(service, port=0) as server,
        Client(f"opc.tcp://127.0.0.1:{server.bserver.port}/dengine") as client,
    ):
        yield Plant(service, client, await client.get_namespace_index(opcua.NAMESPACE))


async def test_a_plc_decides_and_reports_and_a_scada_sees_it(plant: Plant, stream: Dataset) -> None:
    actions = []
    for i, (x, good) in enumerate(zip(stream.X[:120], stream.y, strict=False)):
        action, id_, _, lower, upper, version = await plant.decide(x, f"order-{i}", f"P{i}")
        assert (id_, 0.0 <= lower <= upper <= 1.0) == (f"order-{i}", True)
        actions.append(action)
        if action == VERIFY:
            assert await plant.report(id_, bool(good)) is True
    assert ACCEPT in actions
    assert await plant.until("Decisions", lambda n: n == len(actions)) == len(actions)
    assert await plant.value("Accepted") == actions.count(ACCEPT)
    assert await plant.value("ModelVersion") == version >= 1
    assert await plant.value("VerifiedShare") == actions.count(VERIFY) / len(actions)
    assert (await plant.value("SafeMode"), await plant.value("Shadow")) == (False, False)
    assert await plant.report("unheard of", True) is False
    with pytest.raises(ua.uaerrors.BadInvalidArgument):
        await plant.decide(stream.X[1], "order-0")
    assert "got another" in await plant.value("LastRefused")
    match = await plant.service.find("order-7")
    assert (match.decision.part, np.array_equal(match.trace[0], stream.X[7])) == ("P7", True)


UA = "{http://opcfoundation.org/UA/2011/03/UANodeSet.xsd}"
ARGUMENTS = {  # of each method in the file's order: its arguments, then its results
    "Decide": [
        [("Trace", FLOAT, 1), ("Channels", COUNT, -1), ("Request", TEXT, -1), ("Part", TEXT, -1)],
        [
            ("Action", ua.VariantType.Int32, -1),
            ("Id", TEXT, -1),
            ("Reason", TEXT, -1),
            ("Lower", ua.VariantType.Double, -1),
            ("Upper", ua.VariantType.Double, -1),
            ("ModelVersion", COUNT, -1),
        ],
    ],
    "Report": [
        [("Id", TEXT, -1), ("Success", ua.VariantType.Boolean, -1)],
        [("Kept", ua.VariantType.Boolean, -1)],
    ],
}


async def test_the_variables_and_methods_are_as_the_file_and_the_page_describe_them_and_read_only(
    plant: Plant, repo: Path
) -> None:
    page = (repo / "docs" / "howto" / "plc_and_robot.md").read_text(encoding="utf-8")
    file = ElementTree.parse(Path(opcua.__file__).with_name("cell.xml"))
    variables = {
        item.get("NodeId").removeprefix("ns=1;s=Cell."): item
        for item in file.iter(f"{UA}UAVariable")
        if item.get("DataType") != "Argument"
    }
    assert set(variables) == {*opcua.STATUS_NAMES, "LastRefused"}
    for name, item in variables.items():
        node, text = plant.node(f"Cell.{name}"), item.findtext(f"{UA}Description")
        type_ = ua.VariantType[item.get("DataType")]
        assert await node.read_data_type_as_variant_type() is type_, name
        assert (await node.read_data_value()).Value.VariantType is type_, name
        assert (await node.read_description()).Text == text
        assert f"| `Cell.{name}` | {type_.name} | " in page
        with pytest.raises(ua.UaStatusCodeError):
            await node.write_value(await node.read_value())
    with pytest.raises(ua.UaStatusCodeError):
        await plant.client.nodes.objects.add_folder(plant.index, "mine")
    for method, (taken, given) in ARGUMENTS.items():
        for name, arguments in (("InputArguments", taken), ("OutputArguments", given)):
            node = await plant.node(f"Cell.{method}").get_child(f"0:{name}")
            items = await node.read_value()
            assert [(item.Name, item.DataType.Identifier, item.ValueRank) for item in items] == [
                (name, type_.value, rank) for name, type_, rank in arguments
            ]
            assert all(item.Description.Text for item in items)


@pytest.mark.parametrize("empty", [None, ""])
async def test_the_example_client_plays_a_shift_with_a_controllers_types_and_empty_texts(
    tmp_path: Path, repo: Path, empty: str | None
) -> None:
    play = runpy.run_path(str(repo / "training" / "opcua_client.py"))["play"]
    with a_service(
        tmp_path / "cell.db", Recipe.load("pca").with_policy(alpha=0.3, lower_bound=0.7)
    ) as service:
        async with opcua.opcua_server(service, port=0) as server:
            counts, *variables = await play(
                f"opc.tcp://127.0.0.1:{server.bserver.port}/dengine", 120, empty
            )
            await service.call(lambda engine: engine.flush())
        expected = [
            past.decision for past in service.read_store.decisions.select(HistoryFilter(), 1000)
        ]
    n = {
        action: sum(item.action == action for item in expected)
        for action in ("verify", "accept", "reject")
    }
    assert counts == ", ".join(f"{count} {action}" for action, count in n.items())
    assert (sum(n.values()), n["accept"] > 0) == (120, True)
    assert (
        sum(item.part is None for item in expected) == 60
    )  # an empty text, or none, is no part's number
    assert all(len(item.id) > 3 for item in expected)  # nor an id of the caller's
    assert [line.partition(": ")[0] for line in variables][:2] == ["Decisions", "VerifiedShare"]


async def test_a_null_text_is_an_empty_one_of_whatever_form(plant: Plant, stream: Dataset) -> None:
    for null in (ua.Variant(None, TEXT), ua.Variant(None, ua.VariantType.Null)):
        action, id_, *_ = await plant.call(
            "Decide", ua.Variant(stream.X[3].tolist(), FLOAT), ua.Variant(1, COUNT), null, null
        )
        assert (action in (0, 1, 2), id_ != "") == (True, True)
        assert (await plant.service.find(id_)).decision.part is None


SOUND = {
    "Trace": ua.Variant([1.0] * 60, FLOAT),
    "Channels": ua.Variant(1, COUNT),
    "Request": ua.Variant("", TEXT),
    "Part": ua.Variant("", TEXT),
}
WRONG = [  # an argument, its value and type, and the end of what is said of it
    ("Trace", [1.0] * 60, "Double", "got Double array, UInt32, String, String."),
    ("Trace", 1.0, "Float", "got Float, UInt32, String, String."),
    ("Trace", None, "Null", "got String, UInt32, String, String."),
    ("Trace", [1.0] * 10, "Float", ""),
    ("Channels", 1, "Int32", "got Float array, Int32, String, String."),
    ("Channels", [1], "UInt32", "got Float array, UInt32 array, String, String."),
    ("Channels", None, "Null", "got Float array, String, String, String."),
    ("Channels", 2, "UInt32", ""),  # two channels of a cell of one
    ("Request", ["a"], "String", "got Float array, UInt32, String array, String."),
    ("Request", b"a", "ByteString", "got Float array, UInt32, ByteString, String."),
    ("Request", "a\nb", "String", ""),
    ("Part", True, "Boolean", "got Float array, UInt32, String, Boolean."),
]


@pytest.mark.parametrize(("name", "value", "kind", "end"), WRONG)
async def test_a_wrong_argument_is_a_bad_status_and_named(
    plant: Plant, name: str, value: Any, kind: str, end: str
) -> None:
    before = await plant.decisions()
    given = SOUND | {name: ua.Variant(value, getattr(ua.VariantType, kind))}
    with pytest.raises(ua.uaerrors.BadInvalidArgument):
        await plant.call("Decide", *given.values())
    refused = await plant.value("LastRefused")
    assert refused.startswith("Expected ")
    assert refused.endswith(end)
    assert await plant.decisions() == before


async def test_a_call_with_too_few_arguments_or_no_bool_for_a_label_is_a_bad_status(
    plant: Plant,
) -> None:
    with pytest.raises(ua.uaerrors.BadInvalidArgument):
        await plant.call("Decide")
    assert (await plant.value("LastRefused")).endswith("Part (String), got none.")
    with pytest.raises(ua.uaerrors.BadInvalidArgument):
        await plant.call("Report", ua.Variant("order-1", TEXT), ua.Variant(1, ua.VariantType.Int32))


async def test_an_alarm_is_a_variable_and_an_event(
    plant: Plant, stream: Dataset, monkeypatch
) -> None:
    heard: asyncio.Queue[Any] = asyncio.Queue()

    class Listener:
        def event_notification(self, event: Any) -> None:
            heard.put_nowait(event)

    subscription = await plant.client.create_subscription(50, Listener())
    await subscription.subscribe_events()
    await plant.service.call(lambda engine: engine.set_shadow(True, "the operator"))
    assert await plant.until("Shadow", bool)
    await plant.service.call(lambda engine: engine.set_shadow(False, "the operator"))
    assert not await plant.until("Shadow", lambda on: not on)
    result = await plant.service.status()
    monkeypatch.setattr(
        plant.service, "status", lambda: asyncio.sleep(0, replace(result, store_fault="disk full"))
    )
    await plant.decide(stream.X[0])
    assert await plant.until("Alarm", bool)
    event = await asyncio.wait_for(heard.get(), 60)
    assert (event.Severity, event.SourceName) == (opcua.ALARM, "Cell")
    assert (
        event.Message.Text
        == await plant.value("AlarmText")
        == "The store cannot be written: disk full"
    )


async def test_a_store_that_cannot_be_read_leaves_values_that_say_they_are_old(
    plant: Plant, monkeypatch
) -> None:
    async def away() -> None:
        raise RuntimeError("the store is away")

    decided = await plant.decisions()
    before = await plant.until("Decisions", lambda n: n == decided)
    for stand_in, status in ((away, "UncertainLastUsableValue"), (plant.service.status, "Good")):
        monkeypatch.setattr(plant.service, "status", stand_in)
        async with asyncio.timeout(60):
            while (read := await plant.read("Decisions")).StatusCode.value != getattr(
                ua.StatusCodes, status
            ):
                await plant.service.call(lambda engine: None)
                await asyncio.sleep(0.05)
        assert read.Value.Value == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"host": "0.0.0.0"}, "a token, a certificate and a key"),
        ({"host": "0.0.0.0", "tokens": ["a token"]}, "a token, a certificate and a key"),
        ({"host": "0.0.0.0", "cert": "c.pem", "key": "k.pem"}, "a token, a certificate and a key"),
        ({"cert": "c.pem"}, "a certificate and its key together"),
    ],
)
async def test_elsewhere_it_wants_a_token_and_everywhere_a_certificate_with_its_key(
    service: CellService, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        async with opcua.opcua_server(service, port=0, **options):
            raise AssertionError("it must not be served")


async def test_with_a_certificate_only_who_encrypts_and_knows_the_token_gets_in(
    service, tmp_path, monkeypatch
) -> None:
    certificate(tmp_path, "urn:dengine:server")
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    encrypted = f"Basic256Sha256,SignAndEncrypt,{cert},{key}"

    async def connect(port: int, security: str | None, user: str, password: str) -> int:
        client = Client(f"opc.tcp://127.0.0.1:{port}/dengine")
        client.application_uri = "urn:dengine:server"
        if security:
            await client.set_security_string(security)
        if user:
            client.set_user(user)
            client.set_password(password)
        async with client:
            index = await client.get_namespace_index(opcua.NAMESPACE)
            return await client.get_node(ua.NodeId("Cell.ModelVersion", index)).read_value()

    async with opcua.opcua_server(service, 0, "127.0.0.1", ["s3cret"], cert, key) as server:
        assert (
            await connect(server.bserver.port, encrypted, "dengine", "s3cret")
            == service.engine.version
        )
        for security, *who in (
            (encrypted, "dengine", "wrong"),
            (encrypted, "admin", "s3cret"),
            (encrypted, "", ""),
        ):
            with pytest.raises((ua.UaError, ConnectionError, TimeoutError)):
                await connect(server.bserver.port, security, *who)
        # A client that does not care for what the server's endpoints are gets no session either.
        monkeypatch.setattr(
            Client, "find_endpoint", staticmethod(lambda endpoints, *wanted: endpoints[0])
        )
        with pytest.raises(ua.uaerrors.BadUserAccessDenied):
            await connect(server.bserver.port, None, "dengine", "s3cret")
