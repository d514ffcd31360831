"""What people may do from the page: each act is confirmed, carries its author, and stays in the event log.

A request must come from this page: of the same origin, and with the token that only the page knows.
"""

from __future__ import annotations

import secrets
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
from .looking import Looking

LARGEST = 8192  # bytes of a form
LONGEST = 100  # characters of an author

Form = Mapping[str, str]
Act = Callable[[DataEngine, Form, str], bool]  # done with a form, by its author; whether anything changed


def _correct(engine: DataEngine, form: Form, author: str) -> bool:
    said = {"good": True, "bad": False}.get(form.get("label", ""))
    if said is None:
        raise ReportError(f"Expected label to be good or bad, got {form.get('label', '')[:20]!r}.")
    return engine.correct(form.get("id", ""), said, author).event is not None


def _rollback(engine: DataEngine, form: Form, author: str) -> bool:
    number = form.get("version", "")
    if not (number.isascii() and number.isdigit() and len(number) < 10):
        raise SettingError(f"Expected the number of a version, got {number[:20]!r}; choose one of the list.")
    return engine.rollback(int(number), author).event is not None


def _retrain(engine: DataEngine, form: Form, author: str) -> bool:
    under_way = engine.retraining
    engine.store.put_event("retrain", "asked for on the page", author=author)
    engine.start_retrain()
    return not under_way


ACTS: dict[str, tuple[Act, str]] = {  # what it does, and what is said once it is done
    "shadow-on": (
        lambda engine, form, author: engine.set_shadow(True, author).event is not None,
        "Every part is verified from now on.",
    ),
    "shadow-off": (
        lambda engine, form, author: engine.set_shadow(False, author).event is not None,
        "The model decides again.",
    ),
    "correct": (_correct, "The label is corrected."),
    "rollback": (_rollback, "The earlier model answers again."),
    "retrain": (_retrain, "The retrain has begun; its model answers as soon as it is ready."),
}
REFUSED = "Expected a request of this page, got another: load the page again."
NOTHING = "Nothing changed: it was so already."
NO_AUTHOR = "Expected your name, got none: it goes into the event log."


class Acts:
    """The acts of one page.  token : what a request of it carries."""

    def __init__(self, looking: Looking) -> None:
        self.token = secrets.token_urlsafe(32)
        self._service, self._looking = looking.service, looking

    async def answer(self, name: str, request: Request) -> Response:
        """Do what a form asks for, and say what became of it; an unknown act is a 404."""
        try:
            form = await self._form(request)
            author = _author(form)
            response = await (self._export(author) if name == "export" else self._do(name, form, author))
        except Refusal as refusal:
            return _said(refusal.detail, refusal.status, refusal.headers)
        except (DengineError, OSError) as error:
            why = " ".join(str(error).split())
            return _said(f"It was not done: {why}", 503 if isinstance(error, BusyError) else 409)
        self._looking.look_anew()
        return response

    async def _do(self, name: str, form: Form, author: str) -> Response:
        act = ACTS.get(name)
        if act is None:
            raise Refusal(404, REFUSED)
        changed = await self._service.ask(lambda engine: act[0](engine, form, author))
        return _said(act[1] if changed else NOTHING)

    async def _export(self, author: str) -> Response:
        content, version = await self._service.ask(lambda engine: _exported(engine, author))
        name = {"content-disposition": f'attachment; filename="model_{version}.zip"'}
        return Response(content, media_type="application/zip", headers=name)

    async def _form(self, request: Request) -> Form:
        """The form of a request of this page. Refusal for any other."""
        if not _same_origin(request):
            raise Refusal(403, REFUSED)
        body = await read_body(request, LARGEST)
        if body is None:
            raise Refusal(413, REFUSED)
        try:
            fields = parse_qs(body.decode("utf-8", "replace"), max_num_fields=20)
        except ValueError as error:  # more fields than that
            raise Refusal(413, REFUSED) from error
        form = {key: values[-1] for key, values in fields.items()}
        if not is_same(self.token, form.get("token", "")):
            raise Refusal(403, REFUSED)
        return form


def _said(text: str, status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    return JSONResponse({"said": text}, status, headers)


def _same_origin(request: Request) -> bool:
    """Whether a browser says that the request came from a page of this very server; who does not say it is no page."""
    origin, fetch_site, host = map(request.headers.get, ("origin", "sec-fetch-site", "host"))
    return origin is not None and fetch_site != "none" and is_own_page(origin, fetch_site, host)


def _author(form: Form) -> str:
    author = " ".join(form.get("author", "").split())
    if not author or not author.isprintable() or len(author) > LONGEST:
        raise Refusal(422, NO_AUTHOR)
    return author


def _exported(engine: DataEngine, author: str) -> tuple[bytes, int]:
    """The exported file and its checksum in an archive, and the version that is in it.

    Made in a folder that only this process knows: nothing of a request becomes a path.
    """
    from ...export import export_torchscript

    content = BytesIO()
    with TemporaryDirectory(prefix="dengine-export-") as folder, ZipFile(content, "w") as archive:
        export_torchscript(engine, Path(folder) / "model.ts")
        for file in sorted(Path(folder).iterdir()):
            archive.write(file, file.name)
    engine.store.put_event("export", f"version {engine.version} was downloaded from the page", author=author)
    return content.getvalue(), engine.version
