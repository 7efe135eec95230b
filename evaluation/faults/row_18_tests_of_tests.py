"""Row 18: whether the tests of what must not fail would notice: branch coverage, and mutants that they kill."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from evaluation.faults.checked import MODULES, ROOT
from evaluation.faults.mutants import fingerprint, known, mutate
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict

NUMBER = 18
TARGET = "codec, validator, safe stop, health: branch coverage 100 %; ≥ 90 % of mutants killed"
KILLED = 0.9


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Cover the branches now; of the mutants take what `make mutants` found of these very modules."""
    verdict = Verdict()
    figures: dict[str, Figure] = {}
    branches = 0
    for module, found in covered(say).items():
        percent, missing = found["summary"]["percent_covered"], missed(found)
        branches += found["summary"]["num_branches"]
        figures[f"{name(module)} covered, lines and branches [%]"] = percent
        verdict.need(not missing, f"{module} is not covered at {missing}")
    results = known()
    total = 0
    for module in MODULES:
        result = results.get(module)
        if scale.full:
            say(f"mutating {module}")
            result = mutate(module, max((os.cpu_count() or 2) - 1, 1))
        if result is None:
            verdict.need(False, f"{module} was never mutated: make mutants")
            continue
        total += result.mutants
        figures[f"{name(module)} mutants killed [%]"] = 100.0 * result.share
        verdict.need(result.share >= KILLED, f"of {module} {len(result.survivors)} of {result.mutants} mutants live")
        verdict.need(result.sha256 == fingerprint(module), f"{module} was changed after it was mutated: make mutants")
    fault = f"{total} mutants of four modules{'' if scale.full else ' (of the last `make mutants`)'}"
    proof = f"{branches} branches in {len(MODULES)} modules, {total} mutants tried"
    return verdict.row(NUMBER, fault, TARGET, figures, proof)


def name(module: str) -> str:
    """What a module is called in the table."""
    return Path(module).stem.replace("_", " ")


def covered(say: Say) -> dict[str, dict[str, Any]]:
    """What coverage.py found of each module, by its own tests alone.

    Raises:
        FaultError: they failed, or there are no tests here.
    """
    found: dict[str, dict[str, Any]] = {}
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    for module, tests in MODULES.items():
        if not all((ROOT / t).is_file() for t in tests):
            raise FaultError("the tests are not here: run it in a checkout")
        with tempfile.TemporaryDirectory() as folder:
            data, report = Path(folder) / "data", Path(folder) / "report.json"
            tool = [sys.executable, "-m", "coverage"]
            pytest = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *tests]
            for command in (
                [*tool, "run", "--branch", f"--data-file={data}", f"--include={module}", *pytest],
                [*tool, "json", f"--data-file={data}", "-o", str(report), "-q"],
            ):
                done = subprocess.run(
                    command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
                )  # fmt: skip
                if done.returncode:
                    raise FaultError(f"the tests of {module} failed: {(done.stdout + done.stderr)[-600:]}")
            found[module] = json.loads(report.read_text())["files"][module]
        say(f"{module}: {found[module]['summary']['percent_covered']:.1f} % covered")
    return found


def missed(found: dict[str, Any]) -> list[str]:
    """Lines and branches that no test takes, `!` of `pragma: no cover` too: nothing is to be left out."""
    lines = [str(n) for n in found["missing_lines"]]
    branches = [f"{a}→{b}" for a, b in found["missing_branches"]]
    return [*lines, *branches, *(f"{n}!" for n in found["excluded_lines"])]
