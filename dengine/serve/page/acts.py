"""What people may do from the page: each act is confirmed, carries its author, and stays in the event log.

A request must come from this page: of the same origin, and with the token that only the page knows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import parse_qs
from zipfile import ZipFile

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from ...engine.engine import DataEngine
from ...errors import BusyError, DengineError, ReportError, SettingError
from ..api import Refusal, read_body
from ..auth import is_own_page, is_same
from ..service import CellService

LARGEST = 8192  # bytes of a form
LONGEST = 100  # characters of an author
REFUSED = "Expected a request of this page, got another: load the page again."
Form = Mapping[str, str]
Act = Callable[[DataEngine, Form, str], object]  # done with a form, by its author; false where nothing changed


def _correct(engine: DataEngine, form: Form, author: str) -> object:
    label = form.get("label", "")
    if label not in ("good", "bad"):
        raise ReportError(f"Expected label to be good or bad, got {label[:20]!r}.")
    return engine.correct(form.get("id", ""), label == "good", author).event


def _rollback(engine: DataEngine, form: Form, author: str) -> object:
    number = form.get("version", "")
    if not (number.isascii() and number.isdigit() and len(number) < 10):
        raise SettingError(f"Expected the number of a version, got {number[:20]!r}; choose one of the list.")
    return engine.rollback(int(number), author).event


def _retrain(engine: DataEngine, form: Form, author: str) -> object:
    under_way = engine.retraining
    engine.store.put_event("retrain", "asked for on the page", author=author)
    engine.start_retrain()
    return not under_way


def _export(engine: DataEngine, form: Form, author: str) -> Response:
    """The exported file and its checksum in an archive, made in a folder that only this process knows."""
    from ...export import export_torchscript

    content = BytesIO()
    with TemporaryDirectory(prefix="dengine-export-") as folder, ZipFile(content, "w") as archive:
        export_torchscript(engine, Path(folder) / "model.ts")
        for file in sorted(Path(folder).iterdir()):
            archive.write(file, file.name)
    engine.store.put_event("export", f"version {engine.version} was downloaded from the page", author=author)
    headers = {"content-disposition": f'attachment; filename="model_{engine.version}.zip"'}
    return Response(content.getvalue(), media_type="application/zip", headers=headers)


ACTS: dict[str, tuple[Act, str]] = {  # what it does, and what is said once it is done
    "shadow-on": (lambda engine, _, by: engine.set_shadow(True, by).event, "Every part is verified from now on."),
    "shadow-off": (lambda engine, _, by: engine.set_shadow(False, by).event, "The model decides again."),
    "correct": (_correct, "The label is corrected."),
    "rollback": (_rollback, "The earlier model answers again."),
    "retrain": (_retrain, "The retrain has begun; its model answers as soon as it is ready."),
    "export": (_export, ""),
}


async def act(service: CellService, token: str, request: Request) -> Response:
    """Do what a form asks for, and say what became of it.  token : what a request of the page carries."""
    try:
        form = await _form(request, token)
        author = " ".join(form.get("author", "").split())
        if not author or not author.isprintable() or len(author) > LONGEST:
            raise Refusal(422, "Expected your name, got none: it goes into the event log.")
        name = request.path_params["name"]
        if name not in ACTS:
            raise Refusal(404, REFUSED)
        do, done = ACTS[name]
        changed = await service.ask(lambda engine: do(engine, form, author))
    except Refusal as refusal:
        return JSONResponse({"said": refusal.detail}, refusal.status, refusal.headers)
    except (DengineError, OSError) as error:
        why = " ".join(str(error).split())
        return JSONResponse({"said": f"It was not done: {why}"}, 503 if isinstance(error, BusyError) else 409)
    if isinstance(changed, Response):
        return changed
    return JSONResponse({"said": done if changed else "Nothing changed: it was so already."})


async def _form(request: Request, token: str) -> Form:
    """The form of a request of this page; Refusal for any other. A program that is no browser says no origin."""
    origin, fetch_site, host = map(request.headers.get, ("origin", "sec-fetch-site", "host"))
    if origin is None or fetch_site == "none" or not is_own_page(origin, fetch_site, host):
        raise Refusal(403, REFUSED)
    body = await read_body(request, LARGEST)
    try:
        fields = parse_qs("" if body is None else body.decode("utf-8", "replace"), max_num_fields=20)
    except ValueError:  # more fields than that
        body = None
    if body is None:
        raise Refusal(413, REFUSED)
    form = {key: values[-1] for key, values in fields.items()}
    if not is_same(token, form.get("token", "")):
        raise Refusal(403, REFUSED)
    return form
