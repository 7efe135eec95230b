"""Mutation testing of the four modules of `checked`: `python -m evaluation.faults.mutants` (`make mutants`).

Every small change of a module that its tests do not notice is a survivor. Each module is mutated by mutmut in a copy of
the checkout of its own, so that nobody who works beside it is disturbed; the shares that were killed stand with the
hash of what was mutated in docs/mutants.json, where row 18 of the fault table reads them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console

from evaluation.faults.checked import MODULES, ROOT

RESULT = ROOT / "docs" / "mutants.json"
COPIED = ("common", "services", "tests", "pyproject.toml")
KILLED_CODES = frozenset({1, 3, 24, 36, 37, 152, 255})
"""Exit codes with which mutmut tells a mutant that tests noticed (also by a crash or by taking too long)."""
_SETTINGS = """
[tool.mutmut]
source_paths = ["common", "services"]
only_mutate = ["{module}"]
pytest_add_cli_args = ["-p", "no:cacheprovider", "-p", "no:xdist", "-q", "--hypothesis-seed=0"]
pytest_add_cli_args_test_selection = {tests}
use_git_change_detection = false
"""


@dataclass(frozen=True)
class Mutated:
    """What became of one module's mutants."""

    sha256: str
    """Of the module's text."""
    mutants: int
    killed: int
    survivors: list[str]
    """Their names, which `mutmut show` knows."""

    @property
    def share(self) -> float:
        """Killed of all."""
        return self.killed / max(self.mutants, 1)


def fingerprint(module: str) -> str:
    """Hash of a module's text as it is now."""
    return hashlib.sha256((ROOT / module).read_bytes()).hexdigest()


def known() -> dict[str, Mutated]:
    """What was found before, by module."""
    if not RESULT.is_file():
        return {}
    return {name: Mutated(**found) for name, found in json.loads(RESULT.read_text()).items()}


def mutate(module: str, workers: int, keep: Path | None = None) -> Mutated:
    """Try every mutant of a module on its tests.

    Args:
        module: one of MODULES.
        workers: processes.
        keep: where the copy stays, with mutmut's results in it; None: it is removed.

    Raises:
        RuntimeError: mutmut did not come to an end; its last words.
    """
    with tempfile.TemporaryDirectory(prefix="mutants-") as temporary:
        folder = keep or Path(temporary) / "copy"
        _copy(folder, module)
        before = fingerprint(module)
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(folder)}
        run = subprocess.run(
            [sys.executable, "-m", "mutmut", "run", "--max-children", str(workers)],
            cwd=folder, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        found = folder / "mutants" / f"{module}.meta"
        codes = json.loads(found.read_text())["exit_code_by_key"] if found.is_file() else {}
        if not codes or None in codes.values():
            raise RuntimeError(f"mutmut on {module} ended early:\n{(run.stdout + run.stderr)[-2000:]}")
    killed = [name for name, code in codes.items() if code in KILLED_CODES or code < 0]
    return Mutated(before, len(codes), len(killed), sorted(set(codes) - set(killed)))


def _copy(folder: Path, module: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    ignore = shutil.ignore_patterns("__pycache__", "*.mcap", "*.rrd")
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=ignore, dirs_exist_ok=True)
        else:
            shutil.copy(source, folder / name)
    with (folder / "pyproject.toml").open("a") as file:
        file.write(_SETTINGS.format(module=module, tests=json.dumps(MODULES[module])))


def main(arguments: list[str] | None = None) -> int:
    """Mutate, tell, and write docs/mutants.json; exit code 1 if a share is below 90 %."""
    parser = argparse.ArgumentParser(prog="python -m evaluation.faults.mutants", description=main.__doc__)
    parser.add_argument("--only", action="append", choices=sorted(MODULES), help="a module (default: all)")
    parser.add_argument("--workers", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--keep", type=Path, help="keep the copies in this folder, for `mutmut show`")
    options = parser.parse_args(arguments)
    console = Console(soft_wrap=True, highlight=False)
    results = known()
    for module in options.only or MODULES:
        console.print(f"mutating {module} ...")
        keep = None if options.keep is None else options.keep.absolute() / module.replace("/", "_")
        results[module] = found = mutate(module, options.workers, keep)
        console.print(f"{module}: {found.killed} of {found.mutants} killed ({100 * found.share:.1f} %)")
        for name in found.survivors:
            console.print(f"  survives: {name}")
        RESULT.write_text(json.dumps({k: asdict(v) for k, v in sorted(results.items())}, indent=1) + "\n")
    return 0 if all(results[m].share >= 0.9 for m in MODULES if m in results) else 1


if __name__ == "__main__":
    raise SystemExit(main())
