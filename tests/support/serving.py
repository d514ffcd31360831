"""Servers for tests: an application at a port of its own, the engine's thread held up, and a certificate."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dengine.errors import DataError


@contextmanager
def served(app: Any, port: int = 0, **options: Any) -> Iterator[int]:
    """An application in a thread of this process; gives its port.  options : of uvicorn."""
    import uvicorn

    from dengine.serve.server import bound

    server = uvicorn.Server(uvicorn.Config(app, **{"log_config": None, "timeout_graceful_shutdown": 1} | options))
    with bound("127.0.0.1", port) as listening:
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        while thread.is_alive() and not server.started:
            thread.join(0.01)
        try:
            yield listening.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join()


class PushedTraces:
    """A recorder of traces that are at hand: what a robot sends is tested where it is recorded."""

    def __init__(self) -> None:
        self.traces: list[Any] = []
        self.armed = 0

    def arm(self) -> None:
        self.traces.clear()
        self.armed += 1

    def record(self, timeout: float) -> SimpleNamespace:
        if not self.traces:
            raise DataError(f"Expected an insertion within {timeout:g} s, none came.")
        return SimpleNamespace(trace=self.traces.pop(0))


@contextmanager
def held(service: Any) -> Iterator[None]:
    """The engine's thread, busy with something else."""
    begun, free = threading.Event(), threading.Event()
    service.submit(lambda engine: (begun.set(), free.wait(60)))
    assert begun.wait(60)
    try:
        yield
    finally:
        free.set()


def certificate(folder: Path, *uris: str) -> None:
    """Files for TLS by the name of localhost: cert.pem, key.pem, and locked.pem with a password."""
    x509 = pytest.importorskip("cryptography.x509", reason="the test's certificate needs cryptography")
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import rsa

    key, now = rsa.generate_private_key(65537, 2048), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    made = x509.CertificateBuilder(name, name, key.public_key(), 7, now - timedelta(1), now + timedelta(2))
    others = [x509.DNSName("localhost"), *map(x509.UniformResourceIdentifier, uris)]
    signed = made.add_extension(x509.SubjectAlternativeName(others), critical=False).sign(key, hashes.SHA256())
    pem, form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    (folder / "cert.pem").write_bytes(signed.public_bytes(pem))
    (folder / "key.pem").write_bytes(key.private_bytes(pem, form, serialization.NoEncryption()))
    (folder / "locked.pem").write_bytes(key.private_bytes(pem, form, serialization.BestAvailableEncryption(b"secret")))
