"""`forefield eval planning`: what it chooses, that every engine gives the same figures, what it says of bad input."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from common.config import ConfigError
from evaluation.planning import command, report
from evaluation.planning.choosing import choices
from evaluation.planning.drivers import known
from rig import configuration
from rig.application import app
from rig.sources import builtin_scenarios

TIMES = re.compile("cycle_ms|wall_s|command")


def _figures(value):
    """A result without what a clock measured."""
    if isinstance(value, dict):
        return {k: _figures(v) for k, v in value.items() if not TIMES.search(k)}
    return value


def _run(**more):
    return command.run(configuration.load(None, []), planners=["idm"], **more)


TWO = ["u_turn", "right_turn#5"]


@pytest.fixture(scope="module")
def here() -> dict:
    return _run(sources=["right_turn#5"])


@pytest.fixture(scope="module")
def two() -> dict:
    return _run(sources=TWO)


def test_the_summary_has_what_it_promises(here: dict):
    promised = {
        "n", "collisions", "collisions_at_fault", "goal_rate", "off_road", "efficiency", "max_accel_lon",
        "max_accel_lat", "p95_jerk", "cycle_ms_p50", "cycle_ms_p99",
    }  # fmt: skip
    summary = here["summary"]["idm"]
    assert promised <= set(summary)
    assert summary["n"] == 1
    assert summary["efficiency"] == pytest.approx(1.0)
    entry = here["scenarios"]["idm"]["right_turn#5"]
    assert entry["goal"] and not entry["collision"] and entry["off_road"] is False
    assert entry["criterion"] == ""
    assert 30.0 < entry["distance_m"] < 130.0
    json.dumps(here, allow_nan=False)


@pytest.mark.slow
def test_processes_give_the_same_figures(two: dict):
    there = _run(sources=TWO, jobs=2)
    assert _figures(there) == _figures(two)
    assert list(two["scenarios"]["idm"]) == TWO


@pytest.mark.slow
def test_a_dask_cluster_of_two_workers_gives_the_same_figures(two: dict):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        there = _run(sources=TWO, cluster=cluster.scheduler_address)
    assert _figures(there) == _figures(two)


@pytest.mark.slow
def test_the_same_command_twice_gives_the_same_figures(here: dict):
    assert _figures(_run(sources=["right_turn#5"])) == _figures(here)


def test_variants_cover_every_name_and_depend_on_the_seed_alone():
    names = list(builtin_scenarios())
    a, b, c = (choices([], 3 * len(names), seed) for seed in (1, 1, 2))
    assert a == b
    assert a != c
    assert {x.family for x in a} == set(names)
    assert len({x.name for x in a}) == len(a)
    assert all(x.seed > 0 for x in a)


def test_a_folder_gives_its_files_and_an_empty_one_is_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match="no \\.xml"):
        choices([str(tmp_path)], 0, 0)
    for name in ("b.xml", "a.csv.gz", "notes.txt"):
        (tmp_path / name).write_text("")
    assert [c.name for c in choices([str(tmp_path)], 0, 0)] == ["a", "b"]
    with pytest.raises(ConfigError, match="twice"):
        choices(["u_turn", "u_turn"], 0, 0)


def test_a_scenario_that_cannot_be_loaded_is_named_and_the_others_are_driven(tmp_path: Path):
    broken = tmp_path / "broken.xml"
    broken.write_text("<commonRoad>")
    result = _run(sources=[str(broken), "dead_end"])
    assert list(result["not_loaded"]) == ["broken"]
    assert "not valid XML" in result["not_loaded"]["broken"]
    assert result["summary"]["idm"]["n"] == 1
    with pytest.raises(ConfigError, match="none of the 1"):
        _run(sources=[str(broken)])


def test_the_page_needs_nothing_else_and_escapes_what_it_is_told(here: dict):
    told = {**here, "not_loaded": {"<b>": "a & b"}}
    text = report.page(told)
    assert "right_turn#5" in text
    assert "<b>" not in text
    assert "&lt;b&gt;" in text and "a &amp; b" in text
    assert not re.search(r"(src|href)=", text)


def test_drives_that_failed_inside_are_counted_and_shown():
    summary = report.summary({"x": {"error": "RuntimeError: no"}})
    assert summary["n"] == 0
    assert summary["errors"] == 1
    assert report.cells("x", {"error": "RuntimeError: no"})[-1] == "RuntimeError: no"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--planner", "nobody"], "there are default"),
        (["--variants", "3", "straight"], "one of them at a time"),
        (["nowhere"], "none of the 1"),
        (["--predictor", "nobody", "straight"], "policy"),
        (["--jobs", "2", "--cluster", "tcp://127.0.0.1:1", "straight"], "one of them"),
        (["--json", "/nowhere/at/all.json", "straight"], "no such folder"),
    ],
)
def test_bad_input_is_one_line_that_says_what_to_do(arguments: list[str], said: str):
    result = CliRunner().invoke(app, ["eval", "planning", *arguments])
    assert result.exit_code == 2
    assert said in " ".join(result.output.split())


def test_a_cluster_that_does_not_answer_is_said_so():
    pytest.importorskip("distributed")
    with pytest.raises(ConfigError, match="no Dask scheduler"):
        _run(sources=["dead_end"], cluster="tcp://127.0.0.1:9")


def test_the_planners_of_the_project_are_known():
    assert {"default", "paper", "current-only", "idm"} <= set(known())


def test_the_held_field_is_the_first_slice_everywhere():
    from evaluation.planning.drivers import HeldField
    from tests.planning.volumes import Growing

    risk = HeldField(Growing()).step(None, None, None, None, 0.0)  # type: ignore[arg-type]
    assert (risk.volume == risk.volume[0]).all()
    assert np.ptp(Growing().step(None, None, None, None, 0.0).volume.max(axis=(1, 2))) > 0


def test_options_that_exclude_each_other_are_said_so():
    with pytest.raises(ConfigError, match="--variants and --tracks: one of them"):
        _run(variants=3, tracks=["x.csv"])


def test_recorded_vehicles_are_replaced_one_after_another(tmp_path: Path):
    table = tmp_path / "road.csv"
    rows = ["rec,track,type,frame,t,x,y,vx,vy,heading,length,width"]
    for name, ahead in (("a", 0.0), ("b", 30.0)):
        rows += [f"r,{name},car,{k},{k / 10:.1f},{ahead + 0.8 * k:.2f},0,8,0,0,4.5,1.8" for k in range(90)]
    table.write_text("\n".join(rows) + "\n")
    result = _run(tracks=[str(table), str(tmp_path / "none.csv")])
    entries = result["scenarios"]["idm"]
    assert set(entries) == {"road#r:a", "road#r:b"}
    assert {e["yardstick"] for e in entries.values()} == {"human"}
    assert entries["road#r:b"]["yardstick_m"] == pytest.approx(8.0 * entries["road#r:b"]["duration_s"], rel=0.1)
    assert list(result["not_loaded"]) == ["none"]
    assert "0 s" not in report.markdown(result).split("\n")[0]


def test_the_poisson_bound_is_the_textbook_one():
    from evaluation.planning.measures import poisson_bound

    assert poisson_bound(0, 1000.0) == pytest.approx(2.9957, abs=1e-3)
    assert poisson_bound(1, 1000.0) == pytest.approx(4.7439, abs=1e-3)
    assert poisson_bound(3, 500.0) == pytest.approx(2 * 7.7537, abs=1e-2)


def test_another_planner_joins_by_an_entry_point_under_its_own_name(monkeypatch: pytest.MonkeyPatch):
    from importlib import metadata

    from evaluation.planning import drivers
    from evaluation.planning.idm_driver import IdmDriver

    points = metadata.EntryPoints(
        [
            metadata.EntryPoint("peer", "evaluation.planning.idm_driver:IdmDriver", drivers.GROUP),
            metadata.EntryPoint("default", "evaluation.planning.idm_driver:IdmDriver", drivers.GROUP),
        ]
    )
    monkeypatch.setattr(drivers.metadata, "entry_points", lambda group: points.select(group=group))
    assert known() == (*drivers.OURS, *drivers.ALONE, *drivers.PEERS, "peer")
    assert isinstance(drivers.driver("peer", {}), IdmDriver)
    with pytest.raises(ConfigError, match="there are default"):
        drivers.driver("nobody", {})
