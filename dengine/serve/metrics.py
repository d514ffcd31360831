"""What a PLC, a SCADA and a robot's program may want to know of the cell, in a dozen plain numbers and texts.

What Prometheus reads: how many decisions of which kind, how long they took, and how the engine stands.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from ..history.status import status
from ..records import RetrainReport
from .service import Answer, CellService, Told

SECONDS = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
RETRAIN_SECONDS = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 1.0, 2.0, 5.0, 15.0, 60.0)


class Metrics:
    """Counts what a service answers over every interface, from now on, and reads how it stands when it is asked."""

    def __init__(self, service: CellService) -> None:
        self._registry = registry = CollectorRegistry()
        labels = ("action", "reason")
        self._decisions = Counter("dengine_decisions", "Decisions answered.", labels, registry=registry)
        self._reports = Counter("dengine_reports", "Labels taken.", ("success", "repeated"), registry=registry)
        self._retrains = Counter("dengine_retrains", "Retrains that ended.", ("accepted",), registry=registry)

        def seconds(name: str, about: str, buckets: tuple[float, ...] = SECONDS) -> Histogram:
            return Histogram(f"dengine_{name}_seconds", about, buckets=buckets, registry=registry)

        self._decide = seconds("decide", "From a trace to its answer, in line too.")
        self._report = seconds("report", "From a label to its being on the disk.")
        self._retrain = seconds("retrain", "From the data to the new version answering.", RETRAIN_SECONDS)
        registry.register(Gauges(service))
        service.observers.append(self.note)

    def note(self, news: Answer | Told | RetrainReport) -> None:
        """Count one of these."""
        if isinstance(news, Answer):
            self._decisions.labels(news.decision.action.value, news.decision.reason.value).inc()
            self._decide.observe(news.seconds)
        elif isinstance(news, Told):
            self._reports.labels(_word(news.success), _word(news.repeated)).inc()
            self._report.observe(news.seconds)
        else:
            self._retrains.labels(_word(news.accepted)).inc()
            self._retrain.observe(news.seconds)

    def text(self) -> tuple[bytes, str]:
        """All of it, and its content type."""
        return generate_latest(self._registry), CONTENT_TYPE_LATEST


class Gauges:
    """How a service stands, read at the moment it is asked."""

    def __init__(self, service: CellService) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        """What Prometheus's registry asks for."""
        service, engine = self._service, self._service.engine
        gauges = (
            ("model_version", "Of the model that answers; 0 before the first retrain.", engine.version),
            ("safe_mode", "1 while everything is verified for what went wrong.", bool(engine.safe_mode)),
            ("shadow", "1 while everything is verified, and the model only says what it would have done.", engine.shadow),
            (
                "store_fault",
                "1 while the store cannot be written, and labels wait in its journal.",
                bool(engine.store_fault),
            ),
            ("retraining", "1 while a retrain is under way.", engine.retraining),
            ("new_labels", "Labels since the last retrain began.", engine.new_labels),
            ("waiting", "Requests in line.", service.waiting),
        )
        for name, about, value in gauges:
            yield GaugeMetricFamily(f"dengine_{name}", about, value=float(value))
        yield CounterMetricFamily("dengine_late", "Decisions verified since the line was too long.", value=service.late)
        yield CounterMetricFamily("dengine_busy", "Requests refused since too many waited.", value=service.busy)


def _word(value: bool) -> str:
    return "true" if value else "false"


@dataclass(frozen=True, slots=True)
class Overview:
    """How the cell is doing.

    decisions, accepted, rejected : since its birth.  verified_share : of the newest 500 decisions; 1 where there is none.
    bad : accepted parts that are known to have been bad, since its birth.
    version : of the model that answers; 0 before the first retrain.
    safe_mode : why everything is verified; "" where it is not.
    shadow : everything is verified, and the model only says what it would have done.
    waiting : requests in line.  late, busy : answers that came too late, and requests that were refused, since the start.
    alarm : what somebody should look at, a line; "" where there is nothing.
    """

    decisions: int
    verified_share: float
    accepted: int
    rejected: int
    bad: int
    version: int
    safe_mode: str
    shadow: bool
    waiting: int
    late: int
    busy: int
    alarm: str


async def overview(service: CellService) -> Overview:
    """How the cell is doing, by its store; no decision waits for it, but where the engine remembers in memory alone."""
    engine = service.engine
    stored = await service.read(status)
    doing = replace(stored, store_fault=engine.store_fault, safe_mode=engine.safe_mode)
    share = doing.newest.verified_share
    return Overview(
        decisions=doing.ever.decisions,
        verified_share=1.0 if share is None else share,
        accepted=doing.ever.accepted,
        rejected=doing.ever.rejected,
        bad=doing.ever.stops,
        version=engine.version,
        safe_mode=engine.safe_mode,
        shadow=engine.shadow,
        waiting=service.waiting,
        late=service.late,
        busy=service.busy,
        alarm=doing.alarm,
    )
