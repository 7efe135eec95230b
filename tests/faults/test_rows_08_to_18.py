"""Quick forms of the rows about the network, the wall clock, the disk, the GPU, the planner, and the tests' own."""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings

from common import topics
from common.bus import BusSettings, open_bus, router
from common.clock import monotonic
from common.messages import Header, StepInputs, Used
from evaluation.faults import __main__ as command
from evaluation.faults.checked import MODULES, ROOT
from evaluation.faults.relay import NAME_OF, VEHICLE, Harm, relay
from evaluation.faults.result import FaultError, Scale
from evaluation.faults.row_08_bad_network import Sent, _age_s, _backwards
from evaluation.faults.row_10_wall_clock import HOUR_NS, READS_A_FILES_AGE, wall_clock, wall_clock_readers
from evaluation.faults.row_17_planner_properties import CASES, SETTINGS, Case, Tally, planned, problems, volume_of
from evaluation.faults.row_18_tests_of_tests import missed
from services.planner.core import Planner
from tests import samples
from tests.waiting import until


def test_through_a_relay_that_loses_repeats_and_delays_nothing_is_used_twice_or_backwards() -> None:
    with router() as endpoint, relay(endpoint, 4) as (between, _):
        connect = BusSettings(connect=(endpoint,))
        with open_bus(connect, VEHICLE, "vehicle") as here, open_bus(connect, NAME_OF["planner"], "planner") as there:
            out, inbox = here.publisher(topics.EGO), there.inbox(topics.EGO)
            until(lambda: out._raw.matching_status.matching, what="the relay")
            between.harm = Harm(loss=0.2, duplicates=0.3, delay_s=(0.0, 0.05))
            used = []
            for i in range(120):
                out.put(samples.ego(x=float(i)), capture_ns=monotonic())
                time.sleep(0.004)  # the rate of its sender
                if (heard := inbox.take()) is not None:
                    used.append(heard.seq)
            until(lambda: not between._queue, what="the last of them")
            assert len(used) > 10 and all(b > a for a, b in itertools.pairwise(used))
            counts = between.counts
            assert counts["lost"] > 5 and counts["duplicated"] > 5 and counts["overtaken"] > 5
            assert counts["carried"] + counts["lost"] == 3 * 120 + counts["duplicated"]  # three read it
            names = {k.partition(":")[2] for k in there.counters}
            assert names <= {"duplicate", "reordered", "overwritten", "stale"} and "reordered" in names


def sent(seq: int, *used: tuple[str, int]) -> Sent:
    step = StepInputs(1_000_000_000, [Used("ego", boot, n, 900_000_000, True) for boot, n in used])
    head = Header(schema="plan", version=(1, 1), source="p", boot="p" * 8, seq=seq, capture_ns=0, sent_ns=0, age_ns=0)
    return Sent(msgspec.structs.replace(head, step=step), step)


def test_steps_that_go_back_are_found() -> None:
    assert _backwards([sent(0, ("a", 3)), sent(1, ("a", 3)), sent(2, ("a", 7)), sent(3, ("b", 0))]) == 0
    assert _backwards([sent(0, ("a", 3)), sent(1, ("a", 2))]) == 1
    assert _backwards([sent(0, ("a", 3)), sent(1, ("b", 0)), sent(2, ("a", 9))]) == 1
    assert _age_s(sent(0, ("a", 1)), topics.EGO) == pytest.approx(0.1)


def test_no_module_of_common_and_services_reads_the_wall_clock_but_the_healthcheck() -> None:
    assert wall_clock_readers() == READS_A_FILES_AGE


@pytest.mark.skipif(not (shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")), reason="no C compiler")
def test_a_wall_clock_can_be_shifted_under_a_process() -> None:
    with wall_clock() as clock:  # it tries three shifts itself
        clock.shift(HOUR_NS)
        assert abs(clock.seen_ns() - HOUR_NS) < 5_000_000_000


def test_kernels_that_do_not_compile_end_the_riskfield_with_an_exit_code_that_is_not_zero(tmp_path: Path) -> None:
    pytest.importorskip("warp")
    with router() as endpoint:
        environment = {**os.environ, "FOREFIELD__BUS__CONNECT": f'["{endpoint}"]'}
        done = subprocess.run(
            [sys.executable, "-m", "evaluation.faults.faulty_riskfield", "build", "0"],
            cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=150,
        )  # fmt: skip
    assert done.returncode == 1 and "fatal" in done.stderr and "injected" in done.stderr


@settings(max_examples=12, suppress_health_check=list(HealthCheck))
@given(CASES)
def test_plans_on_random_volumes_are_finite_end_at_rest_and_stay_within_limits(case: Case) -> None:
    plan = planned(case, volume_of(case), Planner(SETTINGS))
    assert problems(plan, case.ego(), Tally()) == []


def test_what_is_not_covered_is_told_by_line_and_branch() -> None:
    assert missed({"missing_lines": [], "missing_branches": [], "excluded_lines": []}) == []
    found = {"missing_lines": [3], "missing_branches": [[5, 8]], "excluded_lines": [9]}
    assert missed(found) == ["3", "5→8", "9!"]


def test_the_modules_that_are_mutated_and_their_tests_are_there() -> None:
    for module, tests in MODULES.items():
        assert (ROOT / module).is_file() and all((ROOT / t).is_file() for t in tests)


@pytest.mark.slow
@pytest.mark.parametrize("number", [5, 6, 7, 8, 10, 12, 14, 17, 18])
def test_a_row_of_these_runs_and_proves_its_fault(number: int) -> None:
    try:
        row = command.rows()[number](Scale(smoke=True), 1, print)
    except FaultError as e:
        if "compiler" in str(e) or "mounted" in str(e):
            pytest.skip(str(e))
        raise
    assert row.number == number and row.proof and row.figures
