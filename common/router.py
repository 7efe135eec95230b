"""The router as a process: `python -m common.router [--listen tcp/0.0.0.0:7447]`.

With `--secure FOLDER` (of `forefield certs`) or the section `[bus.tls]` it speaks mutual TLS alone and lets each
process onto its own topics only (`common.access`). With `--upstream` it joins another router, such as one at the edge.
"""

from __future__ import annotations

import argparse
import json
import logging
import signal
import sys
import threading
from pathlib import Path

import msgspec

from common import bus_config, config, logs
from common.bus import BusSettings, router
from common.bus_config import Secured, TlsSettings
from common.config import ConfigError
from common.process import Heart, ServiceSettings

log = logging.getLogger("forefield")


def main(arguments: list[str] | None = None) -> int:
    """Run a Zenoh router until SIGTERM or Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m common.router", description=main.__doc__)
    parser.add_argument("--listen", default="", help="endpoint (default tcp/127.0.0.1:7447, secured tls/…)")
    parser.add_argument("--heartbeat", type=Path, help="file to touch every second, for a healthcheck")
    parser.add_argument("--secure", type=Path, metavar="FOLDER", help="ca.pem, certificate.pem and key.pem; mutual TLS")
    parser.add_argument(
        "--vehicle", action="append", metavar="NAME", help="secured: a vehicle to serve (default: as configured)"
    )
    parser.add_argument(
        "--router", action="append", default=[], metavar="NAME",
        help="secured: let the router with the name router.NAME pass on what these vehicles say",
    )  # fmt: skip
    parser.add_argument("--upstream", action="append", default=[], metavar="ENDPOINT", help="another router to join")
    parser.add_argument("--print", action="store_true", help="print Zenoh's configuration, for `zenohd -c`, and end")
    options = parser.parse_args(arguments)
    try:
        tree = config.load()
        settings = config.section(tree, "bus", BusSettings)
        service = config.section(tree, "service", ServiceSettings)
        if options.secure is not None:
            settings = msgspec.structs.replace(settings, tls=TlsSettings.of(options.secure))
        secured = None
        if settings.tls.wanted:
            secured = Secured(tuple(options.vehicle or (config.vehicle(tree),)), tuple(options.router))
        elif options.vehicle or options.router:
            raise ConfigError("--vehicle and --router say whom a secured router lets in: give --secure FOLDER too")
        listen = options.listen or f"{'tls' if secured else 'tcp'}/127.0.0.1:7447"
        if options.print:
            print(json.dumps(bus_config.router(listen, settings, secured, options.upstream), indent=1))
            return 0
        logs.begin("router", service.log_level, service.log_format)
        stop = threading.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: stop.set())
        with router(listen=listen, settings=settings, secured=secured, upstream=options.upstream) as endpoint:
            log.info("listens on %s", endpoint)
            heart = Heart(options.heartbeat)
            while not stop.wait(1.0):
                heart.beat()
    except ConfigError as e:
        print(e, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
