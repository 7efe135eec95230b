"""Logs: plain lines, JSON for machines, colours for a person at a terminal.

The code logs with the standard library; what belongs to a record beyond its text (`seq`, `cause`) is given as `extra`,
and what belongs to all of them (`service`, `boot`, `vehicle`) is told once with `about`. JSON and colours need
structlog (extra `logs`).
"""

from __future__ import annotations

import logging
import sys
from typing import Any, Literal

from common.config import ConfigError

Format = Literal["auto", "text", "json", "pretty"]

_about: dict[str, Any] = {}


def begin(service: str, level: str = "INFO", style: Format = "auto") -> None:
    """Send the log to stderr.

    Args:
        service: name of this process.
        level: lowest level that is shown.
        style: `auto` is `pretty` on a terminal and `text` elsewhere; images set `json`.

    Raises:
        ConfigError: no such level, or structlog is missing.
    """
    _about.clear()
    about(service=service)
    if style == "auto":
        style = "pretty" if sys.stderr.isatty() and _structlog_is_there() else "text"
    if style != "text" and not _structlog_is_there():
        raise ConfigError(f"service.log_format = {style!r} needs structlog: pip install 'forefield[logs]'")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        logging.Formatter(f"%(asctime)s {service} %(levelname)s %(message)s") if style == "text" else _structured(style)
    )
    handler.addFilter(_tell)
    try:
        logging.basicConfig(level=level, handlers=[handler], force=True)
    except ValueError as e:
        raise ConfigError(f"service.log_level: {e}") from None


def about(**fields: Any) -> None:
    """Fields that every record carries from now on."""
    _about.update(fields)


def _tell(record: logging.LogRecord) -> bool:
    for name, value in _about.items():
        record.__dict__.setdefault(name, value)
    return True


def _structlog_is_there() -> bool:
    try:
        import structlog  # noqa: F401
    except ModuleNotFoundError:
        return False
    return True


def _structured(style: Format) -> logging.Formatter:
    import structlog

    last: list[Any]
    if style == "json":
        last = [structlog.processors.dict_tracebacks, structlog.processors.JSONRenderer()]
    else:
        last = [structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())]
    return structlog.stdlib.ProcessorFormatter(
        foreign_pre_chain=[
            structlog.stdlib.add_log_level,
            structlog.stdlib.ExtraAdder(),
            structlog.processors.TimeStamper(fmt="iso", utc=True, key="time"),
        ],
        processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *last],
    )
