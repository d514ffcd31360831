"""`dengine serve`: one engine behind HTTP, XML-RPC and a page."""

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from ..errors import SettingError
from . import options
from .options import COUNT, FILE, TRACE, RecipeChoice
from .run import host_and_port

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..engine.engine import DataEngine

NEEDED = ("starlette", "uvicorn", "prometheus_client", "msgspec", "defusedxml")
PATIENT = 5.0  # seconds that a decision of the demonstration may wait: nobody but who watches waits for it
SPEED, DEADLINE, PORT = click.FloatRange(0.01, 1000.0), click.FloatRange(0.001, 60.0), click.IntRange(1, 65535)
DEMO = "Play the bundled recordings as a robot would; forgotten at the end, or in a new --store."
NAMED = "A name by which the server is called, beside its own."
WAITS = "Seconds that a decision may wait in line; then it is verify, and recorded so."
RATE = "Requests a second of one client; 0: any."
TOKENS = "A file, its owner's alone: a line each, TOKEN, or TOKEN viewer|operator NAME; every request has to say one."


@click.command(epilog=options.ends_in("dengine serve --store cell.db --port 8000"))
@options.store_option("Remembers everything; made where there is none.")
@click.option("--demo", is_flag=True, help=DEMO)
@click.option("--speed", type=SPEED, default=1.0, show_default=True, help="Parts a second of --demo.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Where to listen; any but this machine wants a token.")
@click.option("--port", type=click.IntRange(0, 65535), default=8000, show_default=True, help="0: any that is free.")
@click.option("--token-file", type=FILE, help=TOKENS)
@click.option("--cert", type=FILE, help="For TLS: the certificate, with its chain, in PEM.")
@click.option("--key", type=FILE, help="Its key, in PEM, without a password.")
@click.option("--allow-host", "allow_hosts", multiple=True, metavar="NAME", help=NAMED)
@click.option("--deadline", type=DEADLINE, default=0.5, show_default=True, metavar="S", help=WAITS)
@options.check_option
@options.gathered("form", options.given, TRACE)
@click.option("--rate", type=click.FloatRange(0.0), default=500.0, show_default=True, help=RATE)
@click.option("--largest", type=click.IntRange(1024), default=2**20, show_default=True, help="Bytes of a request's body.")
@click.option("--connections", type=COUNT, default=100, show_default=True, help="Connections at once.")
@click.option("--shadow", is_flag=True, help="Verify every part; the model only says what it would have done.")
@click.option("--xmlrpc/--no-xmlrpc", default=True, show_default=True, help="XML-RPC at /RPC2, as robots' programs speak.")
@click.option("--page/--no-page", default=True, show_default=True, help="The live page, at /.")
@click.option("--opcua", type=PORT, metavar="PORT", help="Speak OPC UA there, as PLC and SCADA do; 4840.")
@click.option("--opcua-cert", type=FILE, help="Its certificate, in PEM.  [default: --cert]")
@click.option("--opcua-key", type=FILE, help="Its key, in PEM.  [default: --key]")
@click.option("--robot", metavar="HOST[:PORT]", help="Record the force of this Universal Robots controller, for XML-RPC.")
@click.option("--trigger", default="register@output_int_register_25", show_default=True, help="When the robot records.")
@options.allow_import_option
@options.new_seed_option
@options.recipe_options
def serve(
    choice: RecipeChoice,
    store: str | None,
    demo: bool,
    speed: float,
    shadow: bool,
    allow_import: bool,
    robot: str | None,
    trigger: str,
    form: dict[str, Any],
    seed: int | None,
    **how: Any,
) -> None:
    """Answer robots, controllers and people.

    It goes on with its store, or starts a new one, and retrains in a process beside it. SIGTERM and Ctrl-C end it in order:
    what is in line is answered, what is known is written. The machine that it runs on may ask without a token; other
    machines reach it only with --host, which wants --token-file, and should have --cert and --key. --samples, --rate-hz,
    --unit, --channels and --fit are the contract that traces keep to; without them a new store takes its first trace's.
    """
    options.must_have("the server", "serve", *NEEDED)
    if how["opcua"]:
        options.must_have("OPC UA", "opcua", "asyncua")
    from ..cells import RtdeRecorder
    from ..datasets import load_dataset
    from ..recipe import Recipe
    from ..serve.demo import POLICY, playing
    from ..serve.server import serve as serve_cell

    recipe = choice.if_asked()
    with ExitStack() as stack:
        if demo:
            if store is not None and Path(store).exists():
                raise SettingError(
                    f"Expected a new file to keep the demonstration in, {store} is there; name another file."
                )
            data = load_dataset("insertion", **{name: value for name, value in form.items() if name != "channel"})
            how["beside"] = [partial(playing, data=data, speed=speed, seed=seed or 0)]
            how["deadline"] = max(how["deadline"], PATIENT)
            recipe = recipe or Recipe.load("conv").with_policy(**POLICY)
            store = store or str(Path(stack.enter_context(TemporaryDirectory(prefix="dengine-demo-"))) / "demo.db")
        if store is None:
            raise click.UsageError("Expected --store FILE|URL, where everything is remembered; or --demo, to look on.")
        if robot:
            host, port = host_and_port(robot)
            how["recorder"] = partial(RtdeRecorder, host, trigger, port=port, **options.recorded_as(form))
            form = {"samples": 1000} | form
        trace = options.trace_of(form)
        make = partial(_opened, store, seed, shadow, recipe=recipe, trace=trace, allow_import=allow_import)
        serve_cell(make, store, click.echo, **how)


def _opened(store: str, seed: int | None, shadow: bool, executor: "Executor", **how: Any) -> "DataEngine":
    from ..engine.engine import DataEngine
    from ..serve.server import tell_safe_mode

    engine = DataEngine.open_or_create(store, seed, executor=executor, on_safe_mode=tell_safe_mode, **how)
    if shadow:
        engine.set_shadow(True, "dengine serve --shadow")
    return engine
