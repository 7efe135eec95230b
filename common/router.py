"""The router as a process: `python -m common.router [--listen tcp/0.0.0.0:7447]`."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from pathlib import Path

from common.bus import router
from common.config import ConfigError


def main(arguments: list[str] | None = None) -> int:
    """Run a Zenoh router until SIGTERM or Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m common.router", description=main.__doc__)
    parser.add_argument("--listen", default="tcp/127.0.0.1:7447", help="endpoint (default %(default)s)")
    parser.add_argument("--heartbeat", type=Path, help="file to touch every second, for a healthcheck")
    options = parser.parse_args(arguments)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        with router(listen=options.listen) as endpoint:
            print(f"router listens on {endpoint}", flush=True)
            while not stop.wait(1.0):
                if options.heartbeat:
                    options.heartbeat.touch()
    except ConfigError as e:
        print(e, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
