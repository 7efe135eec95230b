"""Alarms on textbook cases, their tuning, their statistics; what is read is what volume and equations say."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace as replace_struct
from rich.console import Console
from typer.testing import CliRunner

from common.config import ConfigError
from common.geometry import Polyline
from common.messages import Ego, Map, ObjectClass, Objects, Stamped
from common.risk import RiskParameters
from common.risk_sources import dynamic_sources, shares_at_points
from evaluation.hazards import alarms, command, named, plot, report, statistics, traffic
from evaluation.hazards.episode import STEP_S, Episode, grid
from evaluation.hazards.fingerprint import fingerprint
from evaluation.hazards.footprint import footprint, met, points_at
from evaluation.hazards.published import A_MAX, wttc
from evaluation.hazards.script import actor, standing, straight
from evaluation.hazards.truth import Truth
from evaluation.hazards.ttc import HORIZON_S, ttc_2d, ttc_lane
from evaluation.hazards.watch import SLACK, Cores, FieldWatcher, Seen, watch
from evaluation.hazards.work import Work
from rig.application import app
from rig.report import finite
from rig.sources import load_scenario
from rig.world import ego_at
from services.predictor.core import Predictor
from services.riskfield.core import RiskField
from services.riskfield.settings import RiskfieldSettings

LINE = straight(-300.0, 0.0, 900.0, 0.0)
SIZE = (4.5, 1.8)
INF = float("inf")


def objects(*rows: tuple[float, float, float, float, float], size: tuple[float, float] = SIZE) -> Objects:
    """Rows of x, y, heading, vx, vy."""
    a = np.array(rows, dtype=np.float64).reshape(-1, 5)
    n = len(a)
    return Objects(
        id=np.arange(1, n + 1),
        cls=np.full(n, ObjectClass.CAR, dtype=np.uint8),
        x=a[:, 0],
        y=a[:, 1],
        heading=a[:, 2],
        vx=a[:, 3],
        vy=a[:, 4],
        length=np.full(n, size[0]),
        width=np.full(n, size[1]),
        mass=np.zeros(n),
    )


def both(ego_speed: float, seen: Objects) -> tuple[float, float]:
    ego = ego_at(0.0, 0.0, 0.0, ego_speed)
    return ttc_lane(ego, 300.0, ego_speed, LINE, seen), ttc_2d(ego, 300.0, ego_speed, LINE, seen)


# --- time to collision ---


@given(gap=st.floats(1.0, 60.0), v=st.floats(2.0, 30.0), u=st.floats(-10.0, 30.0))
@settings(max_examples=40, deadline=None)
def test_behind_a_lead_ttc_is_gap_over_closing_speed(gap: float, v: float, u: float):
    lane, plane = both(v, objects((4.5 + gap, 0.0, 0.0, u, 0.0)))
    wanted = gap / (v - u) if v > u else INF
    assert lane == pytest.approx(wanted, rel=1e-6) if v - u > 1e-5 else lane >= 1e5
    if wanted < HORIZON_S - 0.1:
        assert plane == pytest.approx(wanted, abs=0.002)
    elif wanted > HORIZON_S + 0.1:
        assert plane == INF


def test_ttc_in_a_crossing_is_when_the_footprints_meet():
    """Ego at 10 m/s; a car from the right, at 5 m/s, whose front enters the ego's strip when the ego is there."""
    seen = objects((30.0, -15.0, np.pi / 2, 0.0, 5.0))
    enters = (15.0 - 0.9 - 2.25) / 5.0  # its front reaches y = −0.9
    reaches = (30.0 - 0.9 - 2.25) / 10.0  # the ego's front reaches its side
    lane, plane = both(10.0, seen)
    assert plane == pytest.approx(max(enters, reaches), abs=0.002)
    assert lane == INF


def test_ttc_is_infinite_for_who_passes_beside_or_drives_away():
    beside = objects((20.0, 2.0, 0.0, 0.0, 0.0))
    assert both(10.0, beside)[1] == INF
    assert both(10.0, objects((20.0, 0.0, 0.0, 12.0, 0.0))) == (INF, INF)
    assert both(10.0, objects((-20.0, 0.0, 0.0, 5.0, 0.0))) == (INF, INF)
    assert both(10.0, objects()) == (INF, INF)


def test_lane_ttc_looks_at_the_nearest_in_its_lane_only():
    first, second, next_lane = (30.0, 0.0, 0.0, 10.0, 0.0), (60.0, 0.0, 0.0, 0.0, 0.0), (15.0, 3.5, 0.0, 0.0, 0.0)
    assert both(10.0, objects(first, second, next_lane))[0] == INF
    assert both(10.0, objects(second, next_lane))[0] == pytest.approx((60.0 - 4.5) / 10.0)


def test_2d_ttc_follows_the_ego_s_own_path_round_a_bend():
    angle = np.linspace(0.0, 1.5, 300)
    bend = Polyline.of(np.stack((50.0 * np.sin(angle), 50.0 * (1.0 - np.cos(angle))), axis=-1))
    ego = ego_at(0.0, 0.0, 0.0, 10.0)
    at = 40.0 / 50.0
    on_it = objects((50.0 * np.sin(at), 50.0 * (1 - np.cos(at)), at, 0.0, 0.0))
    straight_on = objects((40.0, 0.0, 0.0, 0.0, 0.0))
    assert ttc_2d(ego, 0.0, 10.0, bend, on_it) == pytest.approx(3.55, abs=0.06)
    assert ttc_2d(ego, 0.0, 10.0, bend, straight_on) == INF


@given(distance=st.floats(15.0, 80.0), closing=st.floats(-10.0, 30.0))
@settings(max_examples=40, deadline=None)
def test_worst_ttc_is_when_two_growing_circles_meet(distance: float, closing: float):
    """Along one line |p + v t| = R + a t² is d − c t = R + a t², or, once they have passed, c t − d = R + a t²."""
    ego = ego_at(0.0, 0.0, 0.0, 20.0)
    found = wttc(ego, objects((distance, 0.0, 0.0, 20.0 - closing, 0.0)))
    radii = float(np.hypot(ego.length, ego.width) + np.hypot(*SIZE)) / 2
    wanted = (-closing + np.sqrt(closing**2 + 4 * A_MAX * (distance - radii))) / (2 * A_MAX)
    assert found == pytest.approx(wanted, rel=1e-6)
    assert wttc(ego, objects()) == INF
    assert wttc(ego, objects((radii - 0.1, 0.0, 0.0, 0.0, 0.0))) == 0.0


# --- the field as it is read ---


def scene() -> tuple[Stamped, Ego]:
    episode = named.named()[0].episode
    watcher = Predictor(Cores().predictor, Cores().risk)
    for k in range(-30, 31):
        at = round((k + 1000) * 1e8)
        prediction = watcher.step(Stamped(episode.objects(k), at, at), None, episode.map)
    return Stamped(prediction, at, at), episode.ego(3.0)


def test_the_footprint_s_risk_is_what_the_equations_give_there():
    """Off the volume, by interpolation, against the reference at the same points: risk under the ego at six slices."""
    prediction, ego = scene()
    field = RiskField(RiskfieldSettings(ahead=60.0, ahead_most=60.0, behind=10.0, width=16.0), RiskParameters(), "cpu")
    risk = field.step(prediction, Stamped(ego, prediction.capture_ns, 0), None, None)
    body = footprint(4.5, 1.8)
    sources = dynamic_sources(prediction.value, risk.slice_times, (ego.vx, ego.vy), RiskParameters())
    for j in range(6):
        x = np.array([ego.x + ego.speed * risk.slice_times[j] * f for f in (0.2, 0.5)])
        flat = np.zeros(2)
        px, py = points_at(x, flat, flat, body)
        exact = shares_at_points(px, py, sources, j, (), RiskParameters()).total.max(-1)
        assert met(risk, j, x, flat, flat, body) == pytest.approx(exact, abs=0.03)


def test_the_watcher_s_smaller_grid_reads_the_same_as_the_service_s_own():
    prediction, ego = scene()
    whole = RiskField(RiskfieldSettings(), RiskParameters(), "cpu")
    episode = named.named()[0].episode
    small = FieldWatcher(ego.speed, curved=False, cores=Cores())
    ahead, _ = small.read(prediction, ego, episode, 3.0)
    risk = whole.step(prediction, Stamped(ego, prediction.capture_ns, 0), None, None)
    body = footprint(ego.length, ego.width)
    for j in range(ahead.shape[0]):
        pose = episode.ego_poses(np.array([3.0 + risk.slice_times[j]]))
        assert float(met(risk, j, *pose, body)[0]) == pytest.approx(ahead[j, SLACK], abs=0.03)


def test_nothing_of_the_future_is_seen():
    case = named.named()[2]  # the braking lead
    cut = 20
    kept = round((3.0 + cut * 0.1) / STEP_S) + 1
    changed = []
    for a in case.episode.actors:
        x, y = a.x.copy(), a.y.copy()
        x[kept:] += 50.0
        y[kept:] -= 20.0
        changed.append(replace(a, x=x, y=y))
    other = replace(case.episode, actors=tuple(changed))
    until = replace(case.truth, label="hazard", event_s=cut * 0.1)
    for a, b in zip(
        msgspec.structs.astuple(_AsStruct.of(watch(named.Case(case.episode, until), Cores()))),
        msgspec.structs.astuple(_AsStruct.of(watch(named.Case(other, until), Cores()))),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


class _AsStruct(msgspec.Struct):
    t: object
    field: object
    current: object
    ttc_lane: object
    ttc_2d: object

    @staticmethod
    def of(seen: Seen) -> _AsStruct:
        return _AsStruct(seen.t, seen.field, seen.current, seen.ttc_lane, seen.ttc_2d)


def test_the_field_sees_a_standing_car_ahead_and_nothing_on_an_empty_road():
    t = grid(6.0)
    ahead = standing(ObjectClass.CAR, SIZE, 50.0, 0.0, 0.0, t)
    far = standing(ObjectClass.CAR, SIZE, 50.0, 12.0, 0.0, t)
    for who, warned in ((ahead, True), (far, False)):
        episode = Episode("test", Map(), LINE, 10.0, 300.0, 6.0, (who,))
        seen = watch(named.Case(episode, Truth("hazard", True, 2.0, 0.0, 0, 0.0)), Cores())
        values = alarms.score("field_predictive", seen, {"full_s": 4.0, "fade_s": 4.5, "slack_s": 0.0})
        assert (values.max() >= 0.8) == warned
        if warned:  # contact 4.55 s after the beginning, 3.55 s after frame 10
            assert values[0] < 0.8 <= values[10]
            assert alarms.score("field_predictive", seen, {"full_s": 2.0, "fade_s": 3.0, "slack_s": 0.0})[10] < 0.5


# --- alarms and tuning ---


def seen_of(times: list[float]) -> Seen:
    n = len(times)
    two = np.array(times)
    none = np.full(n, INF)
    return Seen(np.arange(n) * 0.1, np.zeros((n, 3, 11)), np.zeros((n, 3)), none, two, none)


def test_an_alarm_needs_so_many_frames_in_a_row():
    seen = seen_of([9.0, 2.0, 9.0, 2.0, 2.0, 2.0])
    assert alarms.Alarm("ttc_2d", -3.0, 1).first(seen) == pytest.approx(0.1)
    assert alarms.Alarm("ttc_2d", -3.0, 3).first(seen) == pytest.approx(0.5)
    assert alarms.Alarm("ttc_2d", -3.0, 4).first(seen) is None


def test_a_warning_later_than_1_5_s_before_the_event_does_not_count():
    truth = Truth("hazard", True, 2.0, 0.0, 0, 0.0)
    in_time, late = seen_of([9.0] * 5 + [1.0] * 15), seen_of([9.0] * 6 + [1.0] * 14)
    alarm = alarms.Alarm("ttc_2d", -3.0, 1)
    case = named.Case(named.named()[0].episode, truth)
    assert report.correct(alarm, case, in_time)
    assert not report.correct(alarm, case, late)


def test_tuning_finds_the_threshold_that_separates_and_prefers_fewer_false_alarms():
    hazard = Truth("hazard", True, 2.0, 0.0, 0, 0.0)
    harmless = Truth("harmless", False, None, 9.0, None, 3.0)
    watched = [(hazard, seen_of([v] * 20)) for v in (1.0, 2.0, 2.5)]
    watched += [(harmless, seen_of([v] * 20)) for v in (4.0, 5.0, INF)]
    found = alarms.tune("ttc_2d", watched)
    assert found.accuracy == 1.0 and found.false_alarm_rate == 0.0
    assert found.alarm.threshold == pytest.approx(-3.25)
    threshold, accuracy, false = alarms.best_threshold(
        np.array([1.0, 3.0, 2.0, 0.5]), np.array([True, True, False, False])
    )
    assert (accuracy, false) == (0.75, 0.0) and 2.0 < threshold < 3.0


def test_what_lies_farther_ahead_counts_less():
    field = np.zeros((1, 13, 2 * SLACK + 1))
    field[0, 4, SLACK] = 1.0  # met in 2 s
    field[0, 9, SLACK] = 1.9  # met in 4.5 s
    none = np.full(1, INF)
    seen = Seen(np.zeros(1), field, np.zeros((1, 13)), none, none, none)
    for full_s, fade_s, wanted in (
        (1.0, 2.0, 0.0),
        (0.0, 4.0, 0.5),
        (2.0, 4.0, 1.0),
        (1.0, 6.0, 0.8),
        (1.0, 8.0, 0.95),
    ):
        found = alarms.score("field_predictive", seen, {"full_s": full_s, "fade_s": fade_s, "slack_s": 0.0})
        assert found[0] == pytest.approx(wanted)


def test_at_a_wanted_recall_the_fewest_false_alarms_are_chosen():
    hazard = Truth("hazard", True, 2.0, 0.0, 0, 0.0)
    harmless = Truth("harmless", False, None, 9.0, None, 3.0)
    watched = [(hazard, seen_of([v] * 20)) for v in (1.0, 2.0, 5.0, INF)]
    watched += [(harmless, seen_of([v] * 20)) for v in (4.0, 6.0, INF)]
    half, most = (alarms.tune_at_recall("ttc_2d", watched, r) for r in (0.5, 0.75))
    assert half is not None and half.false_alarm_rate == 0.0 and half.alarm.threshold == pytest.approx(-2.0)
    assert most is not None and most.false_alarm_rate == pytest.approx(1 / 3)
    assert alarms.tune_at_recall("ttc_2d", watched, 1.0) is None  # one hazard is never seen


def test_work_in_several_processes_gives_the_same_in_the_same_order():
    things = [9.0, 4.0, 1.0, 0.25]
    assert Work(2).map(math.sqrt, things, "") == Work().map(math.sqrt, things, "") == [3.0, 2.0, 1.0, 0.5]


def test_who_has_left_a_roundabout_is_not_expected_to_go_round():
    """Half a second after the fork the alarms' predictor follows the exit; with the turn rate's word it goes round."""
    case = next(c for c in named.variants(31, 24) if c.episode.name == "roundabout_exit")
    e = case.episode
    miss = {}
    for name, scale in (("alert", 1000.0), ("turn rate decides", 0.2)):
        predictor = Cores.of({"predictor": {"map": {"swerve_scale": scale}}}).new_predictor()
        worst = 0.0
        for k in range(-30, 60):
            at = round((k + 1000) * 1e8)
            p = predictor.step(Stamped(e.objects(k), at, at), None, e.map)
            ahead = round((3.0 + 0.1 * (k + 20)) / STEP_S)
            if k > 0:
                worst = max(
                    worst, float(np.hypot(p.x[0, 19] - e.actors[0].x[ahead], p.y[0, 19] - e.actors[0].y[ahead]))
                )
        miss[name] = worst
    assert miss["alert"] < 0.5 * miss["turn rate decides"]


def test_every_shipped_threshold_was_tuned_on_these_situations_and_other_seeds():
    stored = report.stored()
    assert stored.definitions == fingerprint(named.named())
    assert (stored.seed, stored.count) == (report.TUNING_SEED, report.TUNING_COUNT)
    assert set(stored.methods) == set(alarms.METHODS)
    assert set(stored.at_recall) == {f"{r:g}" for r in report.RECALLS}
    for name, tuned in stored.methods.items():
        assert tuned.alarm.method == name
        assert tuned.alarm.persistence in alarms.PERSISTENCE
        for option, value in tuned.alarm.options.items():
            assert value in alarms.CHOICES[name][option]


def test_the_tuning_seed_is_refused_as_a_test():
    with pytest.raises(ConfigError, match="tuned on this one"):
        command.run(
            {}, seed=report.TUNING_SEED, count=24, tune=False, with_traffic=False, jobs=1, console=Console(quiet=True)
        )


# --- statistics ---


def test_intervals_and_tests_give_known_values():
    low, high = statistics.wilson(95, 100)
    assert (low, high) == (pytest.approx(0.8882, abs=1e-4), pytest.approx(0.9785, abs=1e-4))
    assert statistics.wilson(0, 10)[0] == 0.0 and statistics.wilson(10, 10)[1] == pytest.approx(1.0)
    a = [True] * 10 + [False] * 2 + [True] * 50
    b = [False] * 10 + [True] * 2 + [True] * 50
    assert statistics.mcnemar(a, b) == (10, 2, pytest.approx(0.03857, abs=1e-5))
    assert statistics.mcnemar(a, a) == (0, 0, 1.0)
    low, high = statistics.bootstrap_median(list(np.linspace(0.0, 1.0, 101)))
    assert 0.3 < low < 0.5 < high < 0.7


# --- the whole ---


def test_the_json_keeps_its_contract(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Two named situations and two variants stand for all: the same code, every key."""
    all_of_them = named.named()
    quiet = all_of_them[16]
    few = [all_of_them[3], replace(quiet, episode=replace(quiet.episode, duration_s=3.0))]
    monkeypatch.setattr(report, "named", lambda: few)
    monkeypatch.setattr(report, "variants", lambda seed, count, drawn: iter(few[::-1]))
    tuned = report.stored()
    result = report.measure(seed=5, count=2, tuned=tuned, cores=Cores(), with_traffic=False, work=Work())
    result = json.loads(json.dumps(finite(result), allow_nan=False))
    for part in ("named", "random"):
        assert set(alarms.METHODS) == set(result[part])
        for f in result[part].values():
            assert {"accuracy", "recall", "false_alarm_rate", "median_lead_s", "ci", "n"} <= set(f)
            assert all(0.0 <= f[k] <= 1.0 for k in ("accuracy", "recall", "false_alarm_rate"))
            assert f["n"] == 2
            for k in ("accuracy", "recall", "false_alarm_rate"):
                assert f["ci"][k][0] - 1e-9 <= f[k] <= f["ci"][k][1] + 1e-9
    assert set(result["mcnemar"]["random"]) == set(result["random"]) - {"field_predictive"}
    assert [c["name"] for c in result["cases"]] == ["queue_end", "overtaken_in_next_lane"]
    assert result["named"]["field_predictive"]["accuracy"] == 1.0
    for points in result["frontier"].values():
        rates = [p["recall"] for p in sorted(points, key=lambda p: p["threshold"])]
        assert rates == sorted(rates, reverse=True)
    plot.plot({**result, "cases": result["cases"]}, tmp_path / "hazards.png")
    assert (tmp_path / "hazards.png").stat().st_size > 20_000


def test_in_recorded_traffic_the_ego_never_meets_itself():
    world = load_scenario("following")
    drive = next(iter(traffic._egos("built-in", world)))
    assert drive.ego in world.tracks and len(drive.objects(20).id) == len(world.tracks) - 1
    alone = replace(world, tracks=(*world.tracks, replace(world.tracks[0], id=9, y=world.tracks[0].y + 4.0)))
    drive = next(iter(traffic._egos("built-in", alone)))
    assert drive.ego.id not in drive.objects(20).id
    assert drive.speed(40) == pytest.approx(float(np.hypot(*drive.ego.velocity[40])), rel=0.1)


def test_alarms_of_a_drive_are_counted_once_until_it_is_quiet_again():
    times = [9.0] * 10 + [1.0] * 5 + [9.0] * 5 + [1.0] * 5 + [9.0] * 30 + [1.0] * 3
    seen = seen_of(times)
    alarm = alarms.Alarm("ttc_2d", -3.0, 1)
    assert traffic.onsets(alarm, seen, np.ones(len(times), dtype=bool)) == 2
    assert traffic.onsets(alarm, seen, np.zeros(len(times), dtype=bool)) == 0


@pytest.mark.slow
def test_the_field_beats_both_times_to_collision_on_unseen_variants():
    result = report.measure(seed=77, count=96, tuned=report.stored(), cores=Cores(), with_traffic=False, work=Work())
    field = result["random"]["field_predictive"]
    assert field["accuracy"] > result["random"]["ttc_lane"]["accuracy"] + 0.1
    assert field["accuracy"] > result["random"]["ttc_2d"]["accuracy"]


def test_a_moving_actor_s_velocity_is_a_backward_difference():
    t = grid(4.0)
    car = actor(ObjectClass.CAR, SIZE, LINE, 320.0 + 5.0 * t + 0.5 * 2.0 * np.maximum(t, 0.0) ** 2)
    seen = Episode("test", Map(), LINE, 0.0, 300.0, 4.0, (car,)).objects(10)
    assert seen.vx[0] == pytest.approx(5.0 + 2.0 * 0.95, abs=0.02)


def test_the_configuration_goes_over_the_alarms_own_settings():
    cores = Cores.of({"predictor": {"map": {"heading_tolerance": 0.5}, "past_frames": 7}})
    assert cores.predictor.map.heading_tolerance == 0.5 and cores.predictor.past_frames == 7
    assert cores.predictor.kinematic.turn_sure == Cores().predictor.kinematic.turn_sure == 0.35
    assert Cores.of({}) == Cores()
    with pytest.raises(ConfigError):
        Cores.of({"predictor": {"swerve": 1}})


@pytest.mark.parametrize(("told", "past"), [([], 10), (["--set", "predictor.past_frames=7"], 7)])
def test_the_command_watches_with_the_alarms_own_settings(told, past, monkeypatch):
    used = []

    def run(tree, **more):
        used.append(Cores.of(tree))
        raise ConfigError("enough")

    monkeypatch.setattr(command, "run", run)
    result = CliRunner().invoke(app, ["eval", "hazards", "--seed", "7", *told])
    assert result.exit_code == 2
    assert used[0].predictor == replace_struct(Cores().predictor, past_frames=past)
