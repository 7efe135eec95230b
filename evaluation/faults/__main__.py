"""`python -m evaluation.faults`: run the fault table, row after row, and say what was reached.

Each row is a module `row_*.py` of this package with its `NUMBER` and its `run`, or with several in its `ROWS`: number →
function of a scale, a seed, and a function that is told what is being done. A row that raises is shown as an error with
its reason, and the others go on.
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import pkgutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

import evaluation.faults as package
from evaluation.faults.process import Others
from evaluation.faults.result import FaultError, Row, Say, Scale
from evaluation.faults.table import Entry, from_json, into, markdown, merged, terminal, to_json
from evaluation.faults.timer import timer
from rig.stopping import StopRequest, stoppable

Run = Callable[[Scale, int, Say], Row]
ROOT = Path(__file__).parents[2]


def rows() -> dict[int, Run]:
    """Every row there is, by its number."""
    found: dict[int, Run] = {}
    for module in pkgutil.iter_modules(package.__path__):
        if module.name.startswith("row_"):
            held = importlib.import_module(f"{package.__name__}.{module.name}")
            found |= held.ROWS if hasattr(held, "ROWS") else {held.NUMBER: held.run}
    return dict(sorted(found.items()))


def entry(number: int, run: Run, scale: Scale, seed: int, say: Say) -> Entry:
    """Run one row beside a bare timer; never raises for what goes wrong inside it."""
    begin, others = time.monotonic(), Others()
    row, error = None, ""
    with timer() as beside:
        try:
            row = run(scale, seed, say)
        except FaultError as e:
            error = str(e)
        except Exception as e:  # a row of ours that is broken must not take the others with it
            error = f"{type(e).__name__}: {e}"
            traceback.print_exc()
        took = time.monotonic() - begin
        worst = beside.worst_ms()
    share = others.share()
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return Entry(number, row, error, scale.mode, seed, commit(), now, round(took, 1), round(worst, 1), round(share, 3))


CODE = ("common", "services", "viz", "rig", "evaluation")


def commit() -> str:
    """The commit of this checkout, `+` if its code was changed since; empty outside of one."""
    try:
        name = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.strip()
        changed = subprocess.run(["git", "diff", "--quiet", "HEAD", "--", *CODE], cwd=ROOT, check=False).returncode
    except (OSError, subprocess.CalledProcessError):
        return ""
    return f"{name}+" if changed else name


def main(arguments: list[str] | None = None) -> int:
    """Run the fault table; exit code 0 if every row that was run is reached, 1 if not, 2 on bad options."""
    parser = argparse.ArgumentParser(prog="python -m evaluation.faults", description=main.__doc__)
    parser.add_argument("--full", action="store_true", help="the whole counts (hours) instead of at most 15 minutes")
    parser.add_argument("--smoke", action="store_true", help="the smallest counts: does it work at all?")
    parser.add_argument("--only", type=int, nargs="+", metavar="ROW", help="these rows alone")
    parser.add_argument(
        "--seed", type=int, default=int(time.time()), help="of what is random (default: from the clock)"
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="keep the results there; rows not run stay as they are"
    )
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table between that document's markers")
    options = parser.parse_args(arguments)
    known = rows()
    if options.full and options.smoke:
        parser.error("--full or --smoke")
    if unknown := set(options.only or ()) - set(known):
        parser.error(f"no row {', '.join(map(str, sorted(unknown)))}; there are {', '.join(map(str, known))}")
    try:
        before = from_json(options.json.read_text()) if options.json and options.json.is_file() else []
    except ValueError as e:
        parser.error(f"{options.json}: {e}")
    scale = Scale(full=options.full, smoke=options.smoke)
    chosen = [n for n in known if n in (options.only or known)]
    console = Console(stderr=True)
    done: list[Entry] = []
    console.print(f"seed {options.seed}, rows {', '.join(map(str, chosen))}, {scale.mode}", highlight=False)
    stopped = False
    with stoppable():
        begin = time.monotonic()
        expected = {e.number: e.took_s for e in before if e.mode == scale.mode}
        try:
            for i, number in enumerate(chosen):
                left = chosen[i:]
                known_s = [expected[n] for n in left if n in expected]
                to_go = f", about {sum(known_s):.0f} s to go" if len(known_s) == len(left) else ""
                console.rule(f"row {number} ({i + 1} of {len(chosen)}{to_go})", align="left")

                def say(text: str) -> None:
                    console.print(f"  {time.monotonic() - begin:6.1f} s  {text}", highlight=False, markup=False)

                done.append(entry(number, known[number], scale, options.seed, say))
                last = done[-1]
                why = last.error or (last.row.why if last.row else "")
                machine = f"timer {last.timer_ms:.0f} ms, others {last.others:.0%}"
                say(f"{last.verdict} in {last.took_s:.0f} s, {machine} {why}")
                _keep(options, merged(before, done))
        except StopRequest:
            stopped = True
    Console(width=None if sys.stdout.isatty() else 200).print(terminal(done))
    return 0 if not stopped and all(e.good for e in done) else 1


def _keep(options: argparse.Namespace, entries: list[Entry]) -> None:
    """After every row, so that a run that is ended keeps what it has; of the smallest counts nothing is kept."""
    if options.smoke:
        return
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(to_json(entries))
    if options.markdown:
        into(options.markdown, markdown(entries))


if __name__ == "__main__":
    raise SystemExit(main())
