"""What Prometheus reads: how many decisions of which kind, how long they took, and how the engine stands."""

from collections.abc import Iterator, Mapping

from prometheus_client import CollectorRegistry, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from ..records import RetrainReport
from .service import Answer, CellService, Told

QUICK = 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0  # seconds
SLOW = 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 1.0, 2.0, 5.0, 15.0, 60.0
HEARD: Mapping[type, tuple[str, str, tuple[str, ...], tuple[float, ...]]] = {  # its labels are its fields' names
    Answer: ("decide", "From a trace to its answer, in line too.", ("action", "reason"), QUICK),
    Told: ("report", "From a label to its being on the disk.", ("success", "repeated"), QUICK),
    RetrainReport: ("retrain", "From the data to the new version answering.", ("accepted",), SLOW),
}


class Metrics:
    """Counts what a service answers over every interface, from now on, and reads how it stands when it is asked."""

    def __init__(self, service: CellService) -> None:
        self._service, self._registry = service, CollectorRegistry()
        self._seconds = {
            kind: Histogram(f"dengine_{name}_seconds", about, labels, buckets=buckets, registry=self._registry)
            for kind, (name, about, labels, buckets) in HEARD.items()
        }
        self._registry.register(self)
        service.observers.append(self.observe)

    def observe(self, news: Answer | Told | RetrainReport) -> None:
        """Count one of these, and how long it took."""
        said = news.decision if isinstance(news, Answer) else news
        labels = [str(getattr(said, name)).lower() for name in HEARD[type(news)][2]]
        self._seconds[type(news)].labels(*labels).observe(news.seconds)

    def text(self) -> tuple[bytes, str]:
        """All of it, and its content type."""
        return generate_latest(self._registry), CONTENT_TYPE_LATEST

    def collect(self) -> Iterator[Metric]:
        """How the service stands, at the moment that Prometheus's registry asks, also while its store is away."""
        service = self._service
        engine = service.engine
        core = service.core
        for name, about, value in (
            ("model_version", "Of the model that answers; 0 before the first retrain.", engine.version),
            ("safe_mode", "1 while everything is verified for what went wrong.", bool(engine.safe_mode)),
            ("shadow", "1 while everything is verified, and the model is only asked.", engine.policy.shadow),
            ("store_fault", "1 while the store or its journal cannot be written.", bool(core.store_fault)),
            ("store_lag_seconds", "Age of the oldest record that the store has not taken; 0: none.", core.store_lag),
            ("retraining", "1 while a retrain is under way.", core.is_retraining),
            ("new_labels", "Labels since the last retrain began.", core.new_labels),
            ("waiting", "Requests in line.", service.waiting),
        ):
            yield GaugeMetricFamily(f"dengine_{name}", about, value=float(value))
        yield CounterMetricFamily("dengine_late", "Decisions verified since a deadline was exceeded.", value=service.late)
        yield CounterMetricFamily("dengine_busy", "Requests refused since too many waited.", value=service.busy)
