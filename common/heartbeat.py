"""The heartbeat file: touched while a loop turns, read by a container's healthcheck.

`python -m common.heartbeat FILE [--max-age S]` exits 0 if the file was touched within S seconds, otherwise 1. It opens
no session and imports next to nothing, because it runs every few seconds.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

MAX_AGE_S = 3.0


def main(arguments: list[str] | None = None) -> int:
    """Was the heartbeat file touched lately?"""
    parser = argparse.ArgumentParser(prog="python -m common.heartbeat", description=main.__doc__)
    parser.add_argument("file", type=Path, help="the file named by the setting service.heartbeat")
    parser.add_argument("--max-age", type=float, default=MAX_AGE_S, metavar="S", help="oldest good one (%(default)s s)")
    options = parser.parse_args(arguments)
    try:
        age = time.time() - options.file.stat().st_mtime
    except OSError as e:
        print(f"no heartbeat: {e}", file=sys.stderr)
        return 1
    if not age <= options.max_age:
        print(f"the last heartbeat is {age:.1f} s old", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
