"""Drive scenarios in the closed loop and print each drive, in simulated time and without the bus.

    python -m evaluation.closed_loop [NAME_OR_FILE ...] [--set KEY=VALUE] [--seed N] [--json OUT] [--trace]

`forefield eval planning` compares planners over many scenarios; this is for looking at a few.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from common import config
from evaluation.planning.drivers import Cores
from evaluation.planning.loop import DriveResult, Latency, drive
from rig.settings import RigSettings
from rig.sources import ScenarioError, builtin_scenarios, load_scenario

__all__ = ["Cores", "DriveResult", "Latency", "drive", "main", "row"]

HEAD = (
    "scenario                  drive  wait  stop  coll fault  clear  goal   v     a_lon a_lat jerk95 slow stop  "
    "pred  risk  plan ms  wall"
)


def row(r: DriveResult) -> str:
    """One line of the table."""
    e, found = r.summary["ego"], r.summary["interventions"]
    clear = "    -" if e["min_clearance_m"] is None else f"{e['min_clearance_m']:5.2f}"
    goal = f"{e['goal_t']:5.1f}" if e["reached_goal"] else "   no"
    stops = sum(i["kind"] == "stop" for i in found)
    work = [float(np.median(r.work_ms.get(k, [0.0]))) for k in ("predictor", "riskfield", "planner")]
    return (
        f"{r.scenario[-25:]:25} {r.share('drive'):5.0%} {r.share('waiting'):5.0%} {r.share('safe_stop'):5.0%}"
        f"  {'YES' if e['collision'] else ' no'}  {'YES' if e['collision_at_fault'] else ' no'}  {clear} {goal}"
        f" {e['mean_speed_mps']:5.1f} {e['max_abs_accel_lon']:6.2f} {e['max_abs_accel_lat']:5.2f}"
        f" {e['p95_abs_jerk']:6.2f}"
        f" {len(found) - stops:4} {stops:4}  {work[0]:5.1f} {work[1]:5.1f} {work[2]:5.1f} {r.wall_s:7.1f}"
    )


def main(argv: list[str] | None = None) -> int:
    """Drive the named scenarios, print a table; exit 1 if a collision was at fault, 2 for bad input."""
    parser = argparse.ArgumentParser(
        prog="python -m evaluation.closed_loop", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument(
        "scenarios", nargs="*", help="built-in names, CommonRoad files or names, tables; default: built-in"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--config", type=Path, default=None)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--trace", action="store_true", help="print every plan and intervention")
    options = parser.parse_args(argv)
    results = []
    try:
        tree = config.load(options.config, options.settings)
        print(HEAD)
        for name in options.scenarios or list(builtin_scenarios()):
            scenario = load_scenario(name, seed=options.seed, settings=config.section(tree, "rig", RigSettings))
            result = drive(scenario, tree)
            results.append(result)
            print(row(result), flush=True)
            if options.trace:
                _show(result)
    except (ScenarioError, config.ConfigError) as e:
        print(e, file=sys.stderr)
        return 2
    if options.json is not None:
        options.json.write_text(json.dumps([r.as_dict(plans=options.trace) for r in results], indent=1), "utf-8")
    return int(any(r.summary["ego"]["collision_at_fault"] for r in results))


def _show(result: DriveResult) -> None:
    said = None
    for p in result.plans:
        now = (p["mode"], p["reason"], p["decision"])
        if now != said:
            speeds = f"{p['speed']:5.2f} → {p['desired_speed']:5.2f}"
            print(f"  {p['t']:6.2f} {speeds}  {p['mode']}: {p['reason']} | {p['decision']}")
        said = now
    for i in result.summary["interventions"]:
        print(f"  {i['t']:6.2f} {i['kind']} {i['speed_from']} → {i['speed_to']}: {i['sentence']}")
    for c in result.summary["ego"]["collisions"]:
        print(
            f"  {c['t']:6.2f} collision with {c['id']}: {'at fault' if c['at_fault'] else 'not at fault'}, {c['why']}"
        )


if __name__ == "__main__":
    raise SystemExit(main())
