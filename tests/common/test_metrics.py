"""Metrics are a view of health: every figure that Prometheus reads is one that the status knows."""

from __future__ import annotations

import json
import urllib.request
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from common import metrics, topics
from common.bus import free_port
from common.config import ConfigError
from common.health import DEADLINE, WORK_BUCKETS_S, Health

ROOT = Path(__file__).parents[2]
S = 1_000_000_000


class Clock:
    now = 0

    def __call__(self) -> int:
        return self.now


def served(health: Health, service: str = "planner") -> dict[tuple[str, ...], float]:
    """What a scrape over HTTP reads: (name, *label values) → value."""
    base = free_port() - 10
    with metrics.serving(health, service, base, "127.0.0.1"):
        url = f"http://127.0.0.1:{metrics.port(base, service)}/metrics"
        with urllib.request.urlopen(url, timeout=10) as answer:
            text = answer.read().decode()
    return {
        (s.name, *(v for k, v in sorted(s.labels.items()) if k != "service")): s.value
        for family in text_string_to_metric_families(text)
        for s in family.samples
    }


def lived() -> Health:
    clock = Clock()
    health = Health("planner", clock)
    risk = health.input(topics.RISK)
    for i in range(11):
        risk.arrived(i * S // 10)
    risk.accepted(S // 2)
    clock.now = S
    health.count("risk:stale", 2)
    health.count("risk:overwritten", 3)
    health.count("plan:sent", 20)
    health.count("plan:not_sent_range")
    health.count("mode:drive", 18)
    health.count("step:KeyError")
    health.count(DEADLINE, 4)
    health.say("ready", "driving")
    health.worked(S // 100)
    health.worked(10 * S)
    return health


def test_a_scrape_reads_what_health_knows() -> None:
    seen = served(lived())
    expected = {
        ("forefield_state", "ready"): 1, ("forefield_state", "waiting"): 0, ("forefield_uptime_seconds",): 1,
        ("forefield_input_alive", "risk"): 1, ("forefield_input_valid", "risk"): 1,
        ("forefield_input_rate_ok", "risk"): 1, ("forefield_input_rate_hertz", "risk"): 10,
        ("forefield_input_age_seconds", "risk"): 0.5, ("forefield_received_total", "risk"): 11,
        ("forefield_used_total", "risk"): 1, ("forefield_refused_total", "stale", "risk"): 2,
        ("forefield_skipped_total", "risk"): 3, ("forefield_sent_total", "plan"): 20,
        ("forefield_not_sent_total", "range", "plan"): 1, ("forefield_plans_total", "drive"): 18,
        ("forefield_step_errors_total", "KeyError"): 1, ("forefield_deadline_misses_total",): 4,
        ("forefield_work_seconds_count",): 2, ("forefield_work_seconds_bucket", "1.0"): 1,
        ("forefield_work_seconds_bucket", "0.01"): 1, ("forefield_work_seconds_bucket", "0.005"): 0,
    }  # fmt: skip
    assert {k: seen.get(k) for k in expected} == pytest.approx(expected)


def test_an_input_that_was_never_accepted_has_no_age() -> None:
    health = Health("planner", Clock())
    health.input(topics.RISK)
    seen = served(health)
    assert seen["forefield_input_alive", "risk"] == 0
    assert ("forefield_input_age_seconds", "risk") not in seen


@given(st.lists(st.integers(0, 5 * S), max_size=50))
def test_every_message_is_in_exactly_one_bucket(work: list[int]) -> None:
    health = Health("planner", Clock())
    for ns in work:
        health.worked(ns)
    buckets, total = health.work_histogram()
    assert [n for _, n in buckets] == [sum(w * 1e-9 <= end for w in work) for end in (*WORK_BUCKETS_S, float("inf"))]
    assert total == pytest.approx(sum(work) * 1e-9)


def test_every_process_has_a_port_of_its_own_and_a_taken_one_is_an_error_that_names_it() -> None:
    assert len({metrics.port(9100, s) for s in topics.STATUS_OF}) == len(topics.STATUS_OF)
    base = free_port()
    health = Health("predictor", Clock())
    taken = metrics.serving(health, "predictor", base, "127.0.0.1")
    with (
        taken,
        pytest.raises(ConfigError, match=str(base)),
        metrics.serving(health, "predictor", base, "127.0.0.1"),
    ):
        pass
    with metrics.serving(health, "predictor", base, "127.0.0.1"):
        pass  # and it is free again afterwards


def test_without_a_port_nothing_is_served() -> None:
    with metrics.serving(Health("planner", Clock()), "planner", 0, "not an address"):
        pass


def test_the_dashboard_asks_for_metrics_that_exist() -> None:
    dashboard = json.loads((ROOT / "deploy" / "grafana-dashboard.json").read_text())
    asked = {t["expr"] for panel in dashboard["panels"] for t in panel.get("targets", [])}
    names = {name for name, *_ in served(lived())}
    assert len(asked) >= 8
    for expression in asked:
        words = {
            w for w in expression.replace("(", " ").replace("{", " ").replace("[", " ").split() if "forefield_" in w
        }
        assert words and words <= names, expression
