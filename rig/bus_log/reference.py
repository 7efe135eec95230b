"""Makes the reference drive: a few seconds of a built-in scenario, recorded with everything that a check needs.

    python -m rig.bus_log.reference OUT.mcap        (make reference-drive)

A coarse grid keeps it small; the run-up is long enough for full histories, so that the network predicts too. Renew it
whenever predictor, riskfield or planner are meant to answer otherwise than before.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from common import config
from common.topics import MIB, TOPICS
from rig import configuration, session
from rig.bus_log.drive import recorder
from rig.bus_log.mend import compact
from rig.settings import RigSettings
from rig.sources import load_scenario

SCENARIO = "cut_in"
SETTINGS = (
    "riskfield.h=1.25", "rig.run_up_s=3.2", "service.log_level=WARNING", "planner.offsets=[0.0, 1.0, -1.0]",
)  # fmt: skip
DURATION_S = 0.7
LARGEST_BYTES = 1 * MIB


def main(arguments: list[str]) -> int:
    """Drive, record, write the file; refuses a drive that was not driven or grew too large."""
    out = Path(arguments[0])
    tree = configuration.load(None, list(SETTINGS), "cpu")
    world = load_scenario(SCENARIO, settings=config.section(tree, "rig", RigSettings))
    reports: list[session.Report] = []
    topics = ",".join(suffix for suffix, topic in TOPICS.items() if topic.name != "status")
    with tempfile.TemporaryDirectory() as folder:
        raw = Path(folder) / "raw.mcap"
        options = session.Options(DURATION_S)
        session.play(
            world, tree, options, lambda _: None, reports.append, lambda reached: recorder(reached, raw, topics)
        )
        driven = reports[-1]["modes"]["drive"]
        if driven < 0.9 * DURATION_S:
            print(f"only {driven:.1f} of {DURATION_S} s were driven: is the machine busy?", file=sys.stderr)
            return 1
        n = compact(raw, out)
    size = out.stat().st_size
    print(f"{n} messages, {size / 1024:.0f} KiB in {out}; look at it: forefield replay --check {out}")
    if size > LARGEST_BYTES:
        print(f"larger than {LARGEST_BYTES / 1024:.0f} KiB", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
