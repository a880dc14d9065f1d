"""What Prometheus is told. One registry per app, so that several may live in one process."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

CONTENT_TYPE = CONTENT_TYPE_LATEST
_SECONDS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0)


class Metrics:
    """Counters of one app."""

    def __init__(self) -> None:
        self.registry = registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        self.requests = Counter("refract_requests_total", "Answers", ["route", "status"], registry=registry)
        self.jobs = Counter("refract_jobs_total", "Jobs that ended", ["kind", "outcome"], registry=registry)
        self.cached = Counter("refract_jobs_reused_total", "Requests answered by a job there was", registry=registry)
        self.queued = Gauge("refract_jobs_queued", "Jobs that wait", registry=registry)
        self.running = Gauge("refract_jobs_running", "Jobs under way", registry=registry)
        self.waited = Histogram(
            "refract_queue_seconds", "From request to start", registry=registry, buckets=_SECONDS
        )
        self.worked = Histogram(
            "refract_work_seconds", "From start to end", ["kind"], registry=registry, buckets=_SECONDS
        )
        self.connections = Gauge("refract_connections", "Connections that are open", registry=registry)
        self.refused = Counter(
            "refract_connections_refused_total", "Connections closed for lack of places", ["why"], registry=registry
        )
        self.live = Gauge("refract_live_viewers", "Live viewers that hold a stage", registry=registry)
        self.slots = Gauge("refract_slots", "Places for one job each", ["state"], registry=registry)
        self.slot_failures = Counter(
            "refract_slot_failures_total", "Slots that got no worker and were started again", registry=registry
        )
        self.faults = Counter("refract_worker_faults_total", "Jobs that met a fault of ours", registry=registry)
        self.crashes = Counter("refract_worker_crashes_total", "Workers that ended on their own", registry=registry)

    def text(self) -> bytes:
        return generate_latest(self.registry)
