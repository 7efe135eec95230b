"""Metrics for Prometheus: a view of `common.health`, served as text over HTTP.

Needs prometheus-client (extra `metrics`). Every process of a vehicle has a port of its own, counted from
`service.metrics_port` in the order of `common.topics.STATUS_OF`, so that one setting serves them all:
predictor + 0, riskfield + 1, planner + 2, viz + 3, vehicle + 4.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, get_args

from common.config import ConfigError
from common.health import DEADLINE, Health
from common.messages import State
from common.topics import STATUS_OF

if TYPE_CHECKING:
    from prometheus_client import Metric


def port(base: int, service: str) -> int:
    """Port of one process' metrics."""
    return base + list(STATUS_OF).index(service)


@contextmanager
def serving(health: Health, service: str, base: int, address: str) -> Iterator[None]:
    """Serve the metrics of this process while the `with` lasts; `base` 0: do not.

    Args:
        health: what is shown.
        service: which of `STATUS_OF` this process is; decides the port.
        base: the setting `service.metrics_port`.
        address: where to listen.

    Raises:
        ConfigError: prometheus-client is missing, or the port cannot be listened on.
    """
    if base == 0:
        yield
        return
    try:
        from prometheus_client import CollectorRegistry, start_http_server
        from prometheus_client.registry import Collector
    except ModuleNotFoundError:
        raise ConfigError("service.metrics_port needs prometheus-client: pip install 'forefield[metrics]'") from None

    class View(Collector):
        def collect(self) -> Iterator[Metric]:
            return families(health, service)

    registry = CollectorRegistry(auto_describe=False)
    registry.register(View())
    number = port(base, service)
    try:
        server, thread = start_http_server(number, addr=address, registry=registry)
    except (OSError, OverflowError) as e:
        raise ConfigError(f"service.metrics_port: cannot listen on {address}:{number} for {service}: {e}") from None
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join(timeout=1.0)


def families(health: Health, service: str) -> Iterator[Metric]:
    """Everything that `health` knows, as Prometheus' metric families; times in seconds."""
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily

    status = health.status()

    def counter(name: str, text: str, label: str = "") -> CounterMetricFamily:
        labels = ["service", *label.split()]
        return CounterMetricFamily(f"forefield_{name}", text, labels=labels)

    def gauge(name: str, text: str, label: str = "") -> GaugeMetricFamily:
        return GaugeMetricFamily(f"forefield_{name}", text, labels=["service", *label.split()])

    state = gauge("state", "1 for the state that the service is in, 0 for the others.", "state")
    for name in get_args(State):
        state.add_metric([service, name], float(status.state == name))
    uptime = gauge("uptime_seconds", "Since the process started.")
    uptime.add_metric([service], status.uptime_s)
    work = HistogramMetricFamily(
        "forefield_work_seconds", "From an input's arrival to the put of what rests on it.", labels=["service"]
    )
    buckets, total = health.work_histogram()
    work.add_metric([service], buckets, total)
    yield from (state, uptime, work)

    flags = {
        "alive": gauge("input_alive", "1 if something arrived within its time.", "topic"),
        "rate_ok": gauge("input_rate_ok", "1 if it comes as often as it should.", "topic"),
        "valid": gauge("input_valid", "1 if the last message was accepted.", "topic"),
    }
    rate = gauge("input_rate_hertz", "How often it arrives.", "topic")
    age = gauge("input_age_seconds", "Age of the content that was accepted last; absent before the first.", "topic")
    received = counter("received", "Messages that arrived, used or not.", "topic")
    used = counter("used", "Messages that were accepted.", "topic")
    for topic, one in status.inputs.items():
        for flag, family in flags.items():
            family.add_metric([service, topic], float(getattr(one, flag)))
        rate.add_metric([service, topic], one.rate_hz)
        received.add_metric([service, topic], one.received)
        used.add_metric([service, topic], one.used)
        if one.age_s is not None:
            age.add_metric([service, topic], one.age_s)
    yield from (*flags.values(), rate, age, received, used)

    skipped = counter("skipped", "Messages that a newer one replaced before they were read.", "topic")
    refused = counter("refused", "Messages that were not used, by reason.", "topic reason")
    sent = counter("sent", "Messages sent.", "topic")
    unsent = counter("not_sent", "Own messages that could not be sent, by reason.", "topic reason")
    mode = counter("plans", "Plans, by mode.", "mode")
    errors = counter("step_errors", "Exceptions of a step that were survived, by type.", "error")
    late = counter("deadline_misses", "Results later than a period after they were due.")
    late.add_metric([service], status.counters.get(DEADLINE, 0))
    for name, n in status.counters.items():
        topic, _, reason = name.rpartition(":")
        if topic == "mode":
            mode.add_metric([service, reason], n)
        elif topic == "step":
            errors.add_metric([service, reason], n)
        elif reason == "sent":
            sent.add_metric([service, topic], n)
        elif reason.startswith("not_sent_"):
            unsent.add_metric([service, topic, reason.removeprefix("not_sent_")], n)
        elif reason == "overwritten":
            skipped.add_metric([service, topic], n)
        elif topic in status.inputs:
            refused.add_metric([service, topic, reason], n)
    yield from (skipped, refused, sent, unsent, mode, errors, late)
