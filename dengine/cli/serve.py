"""The subcommand `dengine serve`: one engine behind HTTP, XML-RPC, OPC UA and a live page."""

from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from ..errors import SettingError
from . import options
from .options import FILE, FOLDER, TRACE, RecipeChoice
from .run import host_and_port

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..engine.engine import DataEngine
    from ..records import TraceSpec

MODULES = ("starlette", "uvicorn", "prometheus_client", "msgspec", "defusedxml")
# A decision of the demonstration may wait this many seconds: no robot waits for it.
DEMO_DEADLINE = 5.0


@click.command(epilog=options.example_epilog("dengine serve --store cell.db --port 8000"))
@options.store_option("The engine's store; created if it does not exist.")
@click.option(
    "--demo",
    is_flag=True,
    help=(
        "Play the bundled recordings as a robot would; forgotten at the end, or kept "
        "in a new --store."
    ),
)
@click.option(
    "--host",
    default="127.0.0.1",
    help="Address to listen on; any other address than this machine's own needs a token.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8000,
    help="0: any free port.",
)
@click.option(
    "--token-file",
    type=FILE,
    help=(
        "A file that only its owner can read, with a token on each line: TOKEN, or "
        "TOKEN viewer|operator NAME. Every request then needs a token."
    ),
)
@click.option("--cert", type=FILE, help="For TLS: the certificate with its chain, in PEM.")
@click.option("--key", type=FILE, help="For TLS: the key, in PEM, without a password.")
@click.option(
    "--deadline",
    type=click.FloatRange(0.001, 60.0),
    default=0.5,
    metavar="S",
    help="Seconds that a decision may wait in line; after that it is recorded as verify.",
)
@options.check_option
@options.bundle_options("trace_options", dict, TRACE)
@options.verify_all_option
@click.option(
    "--opcua",
    type=click.IntRange(1, 65535),
    metavar="PORT",
    help="Port of OPC UA, for PLC and SCADA, usually 4840.  [default: off]",
)
@click.option("--opcua-cert", type=FILE, help="Certificate of OPC UA, in PEM.  [default: --cert]")
@click.option("--opcua-key", type=FILE, help="Key of OPC UA, in PEM.  [default: --key]")
@click.option(
    "--robot",
    metavar="HOST[:PORT]",
    help="Record the force of this Universal Robots controller, for XML-RPC.",
)
@click.option(
    "--trigger",
    default="register@output_int_register_25",
    help="When the robot records.",
)
@click.option(
    "--deploy",
    type=FOLDER,
    help=(
        "Only write examples into this new folder: systemd service, container file, "
        "Grafana dashboard, Prometheus alerts."
    ),
)
@options.allow_import_option
@options.new_seed_option
@options.recipe_options
def serve(
    choice: RecipeChoice,
    store: str | None,
    demo: bool,
    shadow: bool,
    allow_import: bool,
    robot: str | None,
    trigger: str,
    deploy: Path | None,
    trace_options: options.Options,
    seed: int | None,
    **settings: Any,
) -> None:
    """Answer robots, controllers and people over the network.

    An engine decides on parts for them over HTTP, XML-RPC and OPC UA, and a web page shows what it
    does. It continues with its store, which must have the settings that are given, or starts a new
    one, and retrains in a separate process. It runs until SIGTERM or Ctrl-C. Then waiting requests
    are answered, within 5 s, everything known is written, and the exit code is 0; a second Ctrl-C
    does not wait for the requests. --shadow (verify every part) stays in force in the store, until
    `dengine policy STORE --shadow off`. --store, --demo or both must be given.

    --demo plays recorded parts like a robot, with a deadline of 5 s or more; if neither --reducer
    nor a setting of the policy (how it decides) or --novelty is given, it decides with the reducer
    conv, alpha 0.1, a lower bound of 90 % and an audit rate (share of checks at random) of 5 %. It
    keeps the parts in --store, and refuses a file that exists; without --store it forgets them at
    the end.

    Without --token-file, programs on the same machine need no token. Other machines reach it only
    with --host, which needs --token-file, and should have --cert and --key. --samples, --rate-hz,
    --unit, --channels and --fit say what a trace looks like. With --demo only --samples counts.
    With --robot a trace has 1000 samples at 500 Hz by default. Otherwise the four other options
    need --samples, and without all five a new store takes the shape of its first trace, and rate
    and unit are unknown. With --deploy nothing is served: examples are written, and that is all; a
    folder that holds something is refused.
    """
    if deploy is not None:
        from shutil import copytree

        from ..files import new_folder

        with new_folder(deploy) as target:
            copytree(Path(__file__).parents[1] / "serve/deploy", target, dirs_exist_ok=True)
        click.echo(f"Wrote {deploy}; its README.md says what each file is for.")
        return
    options.require_modules("the server", "serve", *MODULES)
    if settings["opcua"]:
        options.require_modules("OPC UA", "opcua", "asyncua")
    from ..cells import RtdeRecorder
    from ..datasets import load_dataset
    from ..recipe import Recipe
    from ..serve.demo import POLICY, playing
    from ..serve.server import serve as serve_cell

    recipe = choice.load_if_given(store)
    trace: TraceSpec | None = None
    beside = []
    recorder: Any = nullcontext
    if robot:
        host, port = host_and_port(robot)
        recording, trace = options.recorder_settings(trace_options)
        recorder = partial(RtdeRecorder, host, trigger, port=port, **recording)
    with ExitStack() as stack:
        if demo:
            if store is not None and Path(store).exists():
                raise SettingError(
                    f"Expected a new file to keep the demonstration in, {store} exists; choose "
                    f"another file."
                )
            data = load_dataset("insertion", samples=trace_options.get("samples"))
            trace = data.spec
            beside = [partial(playing, data=data, seed=seed or 0)]
            settings["deadline"] = max(settings["deadline"], DEMO_DEADLINE)
            recipe = recipe or Recipe.load("conv").with_policy(**POLICY)
            if store is None:
                folder = stack.enter_context(TemporaryDirectory(prefix="dengine-demo-"))
                store = str(Path(folder) / "demo.db")
        if store is None:
            raise click.UsageError(
                "Expected --store FILE|URL, where everything is kept, or --demo, to try it out."
            )
        make_engine = partial(
            _open_engine,
            store,
            seed,
            shadow,
            recipe=recipe,
            trace=trace or options.trace_spec_from(trace_options),
            allow_import=allow_import,
        )
        serve_cell(make_engine, store, click.echo, beside, recorder, **settings)


def _open_engine(
    store: str, seed: int | None, shadow: bool, executor: "Executor", **settings: Any
) -> "DataEngine":
    """Open the engine that the server drives, or create it with its store, and return it.

    The engine trains in `executor`, and logs when safe mode, in which every part is verified after
    an alarm, begins or ends. If `shadow` is True, shadow mode, which verifies every part, is turned
    on, and stays on in the store. `seed` is the seed of a new store's engine; None stands for that
    of another robot cell of its product (cells that share labels), or 0; if it is given, a used
    store must have the same seed. `settings` are further arguments of `DataEngine.open_or_create`.
    Raises what that method raises, and what `DataEngine.set_shadow` raises; in the second case the
    engine stays open.
    """
    from ..engine.engine import DataEngine
    from ..serve.server import log_safe_mode

    engine = DataEngine.open_or_create(
        store, seed, executor=executor, on_safe_mode=log_safe_mode, **settings
    )
    if shadow:
        engine.set_shadow(True, "dengine serve --shadow")
    return engine
