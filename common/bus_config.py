"""What a session or a router is told: settings of the bus, and Zenoh's configuration made from them.

Clients on explicit endpoints, no scouting, one router between them; with `[bus.tls]` mutual TLS and nothing else; on
a secured router everything denied that `common.access` does not allow.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import access
from common.config import ConfigError, Settings

ATTEMPT_MS = 500
"""How long one attempt to reach the router may take [ms]."""
RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
"""When a link is tried again."""


class TlsSettings(Settings, frozen=True):
    """Section `[bus.tls]`: who we are, and whom we believe. All three or none; the router's name is always checked."""

    ca: str = ""
    """Certificate of the authority that signed everyone's (PEM file)."""
    certificate: str = ""
    """Our own certificate (PEM file)."""
    key: str = ""
    """Its private key (PEM file)."""

    @staticmethod
    def of(folder: Path) -> TlsSettings:
        """What `forefield certs` put into one process' folder."""
        return TlsSettings(
            ca=str(folder / "ca.pem"), certificate=str(folder / "certificate.pem"), key=str(folder / "key.pem")
        )

    @property
    def wanted(self) -> bool:
        """Whether anything is set."""
        return bool(self.ca or self.certificate or self.key)


class BusSettings(Settings, frozen=True):
    """Section `[bus]`."""

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints of the router."""
    zenoh_config: str = ""
    """A Zenoh configuration file (JSON5) instead of the built-in one: TLS, other transports."""
    shared_memory: bool = False
    """Zenoh's shared memory; drops silently when a receiver stalls, so it is off unless asked for."""
    lease_ms: int = 500
    """A peer silent for this long is gone [ms]."""
    tls: TlsSettings = TlsSettings()


def _built_in(mode: str, settings: BusSettings) -> dict[str, Any]:
    config: dict[str, Any] = {
        "mode": mode,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "transport": {
            "link": {
                # a risk volume is some 40 batches of 64 KiB: with Zenoh's default of a few batches queued, its
                # put waits for the network again and again (6.2 ms for 2.7 MB on loopback, with 16 batches 2.2)
                "tx": {"lease": settings.lease_ms, "queue": {"size": {"interactive_high": 16}}},
                "rx": {"max_message_size": 80 * 1024 * 1024},
            },
            "shared_memory": {"enabled": settings.shared_memory},
        },
    }
    if settings.tls.wanted:
        config["transport"]["link"] |= {"protocols": ["tls"], "tls": _tls(settings.tls)}
    return config


def _tls(tls: TlsSettings) -> dict[str, Any]:
    for name in ("ca", "certificate", "key"):
        path = Path(getattr(tls, name))
        if not getattr(tls, name):
            raise ConfigError(f"bus.tls.{name} is missing: bus.tls needs ca, certificate and key (`forefield certs`)")
        if not path.is_file():
            raise ConfigError(f"bus.tls.{name}: {path}: no such file; `forefield certs` makes a bench's")
        if not os.access(path, os.R_OK):
            raise ConfigError(f"bus.tls.{name}: {path}: not readable by this user (uid {os.getuid()})")
    return {
        "root_ca_certificate": tls.ca,
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        **dict.fromkeys(("listen_certificate", "connect_certificate"), tls.certificate),
        **dict.fromkeys(("listen_private_key", "connect_private_key"), tls.key),
    }


def _checked(endpoints: Iterable[str], settings: BusSettings) -> list[str]:
    """Endpoints, none of which may bypass TLS once it is asked for.

    Raises:
        ConfigError: with `[bus.tls]` an endpoint is not `tls/…`, or without it one is.
    """
    found = list(endpoints)
    for endpoint in found:
        if endpoint.startswith("tls/") != settings.tls.wanted:
            raise ConfigError(
                f"bus: {endpoint}: with bus.tls every endpoint begins with tls/"
                if settings.tls.wanted
                else f"bus: {endpoint}: a tls/ endpoint needs bus.tls.ca, bus.tls.certificate and bus.tls.key"
            )
    return found


@dataclass(frozen=True)
class Secured:
    """What a secured router lets in: processes and routers known by name, each on its own topics alone."""

    vehicles: tuple[str, ...]
    """Vehicles that it serves."""
    routers: tuple[str, ...] = ()
    """Names of other routers that may pass on what these vehicles say."""


def client(settings: BusSettings) -> dict[str, Any]:
    """Configuration of a client.

    Raises:
        ConfigError: endpoints and `[bus.tls]` do not go together, or its files cannot be read.
    """
    endpoints = _checked(settings.connect, settings)
    config = _built_in("client", settings)
    # one attempt is short, because a blocked `zenoh.open` hears no SIGTERM; the bus repeats it
    config["connect"] = {
        "endpoints": endpoints,
        "timeout_ms": ATTEMPT_MS,
        "exit_on_failure": True,
        "retry": RETRY,
    }
    return config


def router(
    endpoint: str, settings: BusSettings, secured: Secured | None = None, upstream: Sequence[str] = ()
) -> dict[str, Any]:
    """Configuration of a router.

    Args:
        endpoint: where it listens.
        settings: lease, shared memory, TLS.
        secured: whom to let in; None: everyone (who comes over TLS, if that is asked for).
        upstream: endpoints of other routers to join; they may come and go.

    Raises:
        ConfigError: endpoints and `[bus.tls]` do not go together, its files cannot be read, a name cannot be used.
    """
    listen, connect = _checked([endpoint], settings), _checked(upstream, settings)
    config = _built_in("router", settings)
    config["listen"] = {"endpoints": listen}
    config["connect"] = {"endpoints": connect, "timeout_ms": -1, "exit_on_failure": False, "retry": RETRY}
    if secured is not None:
        if not settings.tls.wanted:
            raise ConfigError("a secured router needs bus.tls: names are told from certificates")
        try:
            config["access_control"] = access.access_control(secured.vehicles, secured.routers)
            config["low_pass_filter"] = access.size_limits(secured.vehicles)
        except ValueError as e:
            raise ConfigError(str(e)) from None
    return config
