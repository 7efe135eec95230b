"""Every named manoeuvre, driven by the default planner and judged by its own criterion."""

import pytest

from common.messages import Closures
from evaluation.planning import criteria, drivers
from evaluation.planning.tasks import Task, run
from rig import configuration
from rig.sources import builtin_scenarios, load_scenario
from rig.sources.generated import REPLAYED

QUICK = ("crossing_pedestrian",)
"""In the default suite; the others take as long."""
OPEN: dict[str, str] = {"cut_in": "headway 0.797 s six seconds later, 0.8 asked"}
"""What the default planner does not master yet (docs/planning.md)."""
NAMES = sorted(builtin_scenarios())


def _marked(name: str):
    marks = [] if name in QUICK else [pytest.mark.slow]
    marks += [pytest.mark.xfail(reason=OPEN[name], strict=False)] if name in OPEN else []
    return pytest.param(name, marks=marks)


def test_every_manoeuvre_has_a_criterion_and_every_criterion_a_manoeuvre():
    assert set(criteria.CRITERIA) == set(NAMES)
    assert set(criteria.NEEDS_NO_GOAL) | set(REPLAYED) <= set(NAMES)


def drive(name: str, planner: str = "default", seed: int = 0) -> dict:
    scenario = load_scenario(name, seed=seed)
    kind = "replay" if name in REPLAYED else "reactive"
    entry = run(Task(name, name, scenario, (planner,), configuration.load(None, []), kind))[planner]
    assert "error" not in entry, entry
    return entry


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", [_marked(n) for n in NAMES])
def test_the_default_planner_masters(name: str):
    assert drive(name)["criterion"] == ""


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", ["slow_pedestrian", "straight"])
def test_the_planner_of_the_paper_masters(name: str):
    """What the paper shows of Algorithm 1; what it does not master stands in docs/planning.md."""
    assert drive(name, "paper")["criterion"] == ""


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("crossing_pedestrian", "collision at fault"),
        pytest.param("truck_adjacent", "beside the truck", marks=pytest.mark.slow),
        pytest.param("lane_ends", "collision at fault", marks=pytest.mark.slow),
    ],
)
def test_a_criterion_can_fail_who_does_not_foresee(name: str, wrong: str):
    """The IDM along the route brakes for nobody beside or about to cross."""
    assert wrong in drive(name, "idm")["criterion"]


def test_a_closed_line_that_is_run_over_is_told():
    """The same drive with the line closed for longer than anybody waits for."""
    from dataclasses import replace

    from evaluation.planning.loop import drive as loop
    from evaluation.planning.recorder import Recorder

    scenario = load_scenario("stop_line")
    blind = drivers.driver("idm", {})
    record = Recorder()
    loop(replace(scenario, closures=()), {}, cores=blind, watch=record)
    entry = {"goal": True, "collision_at_fault": False, "off_road": False}
    assert "beyond a closed line" in criteria.judge("stop_line", scenario, record, entry)
    assert scenario.closures_at(0.0) != Closures()
