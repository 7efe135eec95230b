"""Logs: one JSON object a line for machines, plain lines otherwise, and what belongs to a record stands in it."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from collections.abc import Iterator

import pytest

from common import logs
from common.config import ConfigError


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    yield
    root.handlers[:], root.level = before[0], before[1]


def said(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().err.splitlines()


def test_json_is_one_object_a_line_with_boot_seq_and_cause(capsys: pytest.CaptureFixture[str]) -> None:
    logs.begin("planner", style="json")
    logs.about(boot="b00t", vehicle="ego")
    logging.getLogger("forefield").info("%s: %s", "ready", "two\nlines", extra={"seq": 7, "cause": "a:3"})
    try:
        raise KeyError("gone")
    except KeyError:
        logging.getLogger("forefield").exception("step failed")
    first, second = map(json.loads, said(capsys))
    assert first.pop("time").endswith("Z")
    assert first == {
        "event": "ready: two\nlines", "level": "info", "service": "planner", "boot": "b00t", "vehicle": "ego",
        "seq": 7, "cause": "a:3",
    }  # fmt: skip
    assert second["level"] == "error" and second["exception"][0]["exc_type"] == "KeyError"


def test_elsewhere_than_on_a_terminal_it_is_a_plain_line(capsys: pytest.CaptureFixture[str]) -> None:
    logs.begin("planner")
    logging.getLogger("forefield").warning("careful")
    (line,) = said(capsys)
    assert line.endswith("planner WARNING careful") and "\x1b" not in line


def test_for_a_person_it_is_readable_and_has_the_fields_too(capsys: pytest.CaptureFixture[str]) -> None:
    logs.begin("planner", style="pretty")
    logging.getLogger("forefield").info("ready", extra={"seq": 7})
    (line,) = said(capsys)
    assert "ready" in line and "seq=7" in line and "planner" in line


def test_levels_below_the_wanted_one_are_silent_and_a_wrong_one_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    logs.begin("planner", level="WARNING")
    logging.getLogger("forefield").info("chatter")
    assert said(capsys) == []
    with pytest.raises(ConfigError, match="log_level"):
        logs.begin("planner", level="LOUD")


def test_without_structlog_plain_lines_work_and_json_says_what_is_missing() -> None:
    code = (
        "import sys; sys.modules['structlog'] = None\n"
        "from common import logs\n"
        "logs.begin('x')\n"
        "try: logs.begin('x', style='json')\n"
        "except Exception as e: print(e)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "forefield[logs]" in done.stdout
