"""`Metrics`: the Prometheus metrics of a server, which `GET /metrics` of `dengine serve` returns.

Histograms count decisions, reports and retrains with their durations; gauges show the state of the
engine when Prometheus reads them.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import generate_latest

from ..records import RetrainReport
from .service import CellService, ReportResponse, ServiceResponse

# Upper limits of the buckets, in seconds.
RESPONSE_BUCKETS = 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0
RETRAIN_BUCKETS = 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 1.0, 2.0, 5.0, 15.0, 60.0


# Arguments of Prometheus's `Histogram` by the type of the response, whose fields are its labels.
HISTOGRAMS: Mapping[type, dict[str, Any]] = {
    ServiceResponse: {
        "name": "dengine_decide_seconds",
        "documentation": "Seconds from a request for a decision to its response, waiting included.",
        "labelnames": ("action", "reason"),
        "buckets": RESPONSE_BUCKETS,
    },
    ReportResponse: {
        "name": "dengine_report_seconds",
        "documentation": "Seconds from a reported outcome until it is on disk.",
        "labelnames": ("success", "repeated"),
        "buckets": RESPONSE_BUCKETS,
    },
    RetrainReport: {
        "name": "dengine_retrain_seconds",
        "documentation": "Seconds from taking the data until the new version decides.",
        "labelnames": ("accepted",),
        "buckets": RETRAIN_BUCKETS,
    },
}


class Metrics:
    """Counts the responses of a service over every interface, and reads its state on demand.

    Parameters
    ----------
    service : CellService
        `observe` is added to its observers.
    """

    def __init__(self, service: CellService) -> None:
        self._service = service
        self._registry = CollectorRegistry()
        self._histograms = {
            kind: Histogram(**arguments, registry=self._registry)
            for kind, arguments in HISTOGRAMS.items()
        }
        self._registry.register(self)
        service.observers.append(self.observe)

    def observe(self, response: ServiceResponse | ReportResponse | RetrainReport) -> None:
        """Add the duration (`seconds`) of a response or a retrain to the histogram of its type.

        There are three histograms: of decisions, of reported outcomes and of retrains. Their
        Prometheus labels are values of the fields that `HISTOGRAMS` names, in lower case: of a
        decision its action and its reason, of a report whether the part was good and whether the
        report was repeated, of a retrain whether its model was put in force. Raises KeyError for
        any other type.
        """
        kind = type(response)
        record = response.decision if isinstance(response, ServiceResponse) else response
        labels = [str(getattr(record, name)).lower() for name in HISTOGRAMS[kind]["labelnames"]]
        self._histograms[kind].labels(*labels).observe(response.seconds)

    def text(self) -> bytes:
        """Return all metrics in Prometheus's text format: the histograms and what `collect` gives.

        The histograms count since the server's start.
        """
        return generate_latest(self._registry)

    def collect(self) -> Iterator[Metric]:
        """Yield gauges and counters with the present state of the engine and its queue.

        They say for example which model version decides, whether the engine is in safe mode (after
        an alarm every part is checked until new outcomes allow decisions), how many requests wait
        in the queue, how many got no decision before the deadline, and how many were refused
        because the queue was full. Prometheus's registry calls this when the metrics are read. It
        reads no database, so that it works while the store is unavailable.
        """
        service = self._service
        engine = service.engine
        state = engine.state
        gauges = (
            (
                "model_version",
                "Version of the model that decides; 0 before the first retrain.",
                engine.version,
            ),
            (
                "safe_mode",
                "1 in safe mode, where parts are verified until new outcomes allow decisions.",
                bool(engine.safe_mode),
            ),
            ("shadow", "1 in shadow mode, where every part is verified.", engine.policy.shadow),
            (
                "store_fault",
                "1 if the store or its journal cannot be written.",
                bool(state.store_fault),
            ),
            (
                "store_lag_seconds",
                "Age of the oldest record that is not in the store yet; 0 without one.",
                state.store_lag,
            ),
            ("retraining", "1 during a retrain.", state.is_retraining),
            ("new_labels", "Labels since the last retrain began.", state.new_labels),
            ("waiting", "Requests in the queue.", service.waiting),
        )
        for name, description, value in gauges:
            yield GaugeMetricFamily(f"dengine_{name}", description, value=value)
        yield CounterMetricFamily(
            "dengine_late", "Decisions verified because the deadline passed.", value=service.late
        )
        yield CounterMetricFamily(
            "dengine_busy", "Requests refused because the queue was full.", value=service.busy
        )
