"""Many scenarios through `forefield run`, one after another, in real time: `python -m evaluation.live [FILES ...]`.

Without files: every recorded scenario in `$FOREFIELD_DATA`. Prints one row for each, and how many do what they should:
after the first plan `drive` at least 80 % of the time and `safe_stop` at most 5 %.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track
from rich.table import Table

from rig.sources import recorded_scenarios

DRIVE_SHARE = 0.8
SAFE_STOP_SHARE = 0.05
COLUMNS = ("scenario", "s", "drive", "stop", "collision", "clearance m", "goal", "end to end p50/p99 ms", "skipped")


def drive(scenario: str, settings: list[str]) -> dict[str, Any]:
    """One run; returns its report, or what went wrong under `error`."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run.json"
        command = [sys.executable, "-P", "-m", "rig.command", "run", "--scenario", scenario, "--json", str(out)]
        for setting in settings:
            command += ["--set", setting]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if not out.is_file():
            said = done.stderr.strip().splitlines()[-1:]
            return {"scenario": Path(scenario).stem, "error": said, "rc": done.returncode}
        report: dict[str, Any] = json.loads(out.read_text())
        return {**report, "rc": done.returncode}


def keeps(report: dict[str, Any]) -> bool:
    """Whether a run drove for most of its time and hardly ever had to stop for a fault."""
    share = report.get("share_after_first_drive", {})
    return bool(share.get("drive", 0.0) >= DRIVE_SHARE and share.get("safe_stop", 1.0) <= SAFE_STOP_SHARE)


def table(reports: list[dict[str, Any]]) -> Table:
    """A row for each run."""
    out = Table(title="Live, over the bus", title_justify="left")
    for name in COLUMNS:
        out.add_column(name, justify="left" if name == "scenario" else "right", no_wrap=True)
    for r in reports:
        if "error" in r:
            out.add_row(r["scenario"], "", "", "", str(r["error"]))
            continue
        ego, share, e2e = r["ego"], r["share_after_first_drive"], r["latency_ms"]["end_to_end"]
        skipped = sum(n for topic, why in r["skipped"].items() if topic != "ego" for n in why.values())
        collision = "at fault" if ego["collision_at_fault"] else "not at fault" if ego["collision"] else "none"
        near = "-" if ego["min_clearance_m"] is None else f"{ego['min_clearance_m']:.2f}"
        out.add_row(
            r["scenario"], f"{r['duration_s']:.1f}", f"{share['drive']:.0%}", f"{share['safe_stop']:.0%}", collision,
            near,
            "yes" if ego["reached_goal"] else "no", f"{e2e['p50'] or 0:.0f}/{e2e['p99'] or 0:.0f}", str(skipped),
        )  # fmt: skip
    return out


def main(arguments: list[str] | None = None) -> int:
    """Run scenarios live and print the table; exit code 0 if every one came through."""
    parser = argparse.ArgumentParser(prog="python -m evaluation.live", description=main.__doc__)
    parser.add_argument("scenarios", nargs="*", help="names or files; default: all of $FOREFIELD_DATA")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    parser.add_argument("--json", type=Path, metavar="OUT.json")
    options = parser.parse_args(arguments)
    scenarios = options.scenarios or list(recorded_scenarios())
    if not scenarios:
        print("no scenarios: name some, or set FOREFIELD_DATA", file=sys.stderr)
        return 2
    console = Console(width=None if sys.stdout.isatty() else 140)
    reports = []
    for scenario in track(scenarios, description="driving", console=Console(stderr=True)):
        reports.append(drive(scenario, options.settings))
        if options.json:
            options.json.write_text(json.dumps(reports))
    console.print(table(reports))
    good = sum(keeps(r) for r in reports)
    console.print(
        f"{good} of {len(reports)} drive at least {DRIVE_SHARE:.0%} of the time,"
        f" with at most {SAFE_STOP_SHARE:.0%} safe stop"
    )
    return 0 if all("error" not in r for r in reports) else 1


if __name__ == "__main__":
    raise SystemExit(main())
