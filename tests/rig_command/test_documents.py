"""What the documents tell a reader to type can be typed: commands, options, targets and files are there."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main

from rig.application import app

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
ENDS = {"|", "||", "&&", ";", ">", "#"}
FENCED = re.compile(r"^```[a-z]*\n(.*?)^```", re.M | re.S)
INDENTED = re.compile(r"^    (\S.*)$", re.M)
QUOTED = re.compile(r"`([^`]+)`")
COMMAND = re.compile(r"(?:^|(?<=[\s(/]))(forefield(?= [a-z])|make(?= [a-z])|python(?: -P)? -m )")


def said(text: str) -> Iterator[list[str]]:
    """The words of every command in a document: lines of its blocks, indented ones, and what stands in backticks."""
    blocks = FENCED.findall(text)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    lines += INDENTED.findall(FENCED.sub("", text).replace("\\\n", " "))
    lines += [" ".join(quoted.split()) for quoted in QUOTED.findall(FENCED.sub("", text))]
    for line in lines:
        for found in COMMAND.finditer(line):
            words = shlex.shlex(line[found.start() :], posix=True, punctuation_chars=True)
            words.whitespace_split, words.commenters = True, "#"
            try:
                told = list(words)
            except ValueError:  # a quotation that goes on elsewhere
                continue
            yield told[: next((i for i, word in enumerate(told) if word in ENDS), len(told))]


SAID = sorted({(path.name, *words) for path in DOCUMENTS for words in said(path.read_text(encoding="utf-8"))})


def test_there_is_something_to_check() -> None:
    assert sum(words[1] == "forefield" for words in SAID) > 40


@pytest.mark.parametrize("told", [s for s in SAID if s[1] == "forefield"], ids=" ".join)
def test_a_command_has_the_options_that_it_is_shown_with(told: tuple[str, ...]) -> None:
    command: Any = typer.main.get_command(app)
    rest = list(told[2:])
    while hasattr(command, "commands"):
        if not rest:
            return
        for name in rest.pop(0).split("|"):  # `train|eval predictor`
            assert name in command.commands, f"forefield has no {name!r}"
        command = command.commands[name]
    known = {flag for parameter in command.params for flag in (*parameter.opts, *parameter.secondary_opts)}
    shown = {word.partition("=")[0] for word in rest if word.startswith("--")}
    assert shown <= known | {"--help"}, f"{' '.join(told)}: no {', '.join(shown - known)}"


@pytest.mark.parametrize("told", [s for s in SAID if s[1] == "make" and len(s) > 2], ids=" ".join)
def test_a_target_of_make_is_there(told: tuple[str, ...]) -> None:
    assert re.search(rf"^{re.escape(told[2])}:", (ROOT / "Makefile").read_text(), re.M), told


@pytest.mark.parametrize("told", [s for s in SAID if s[1].startswith("python")], ids=" ".join)
def test_a_module_is_there(told: tuple[str, ...]) -> None:
    module = told[told.index("-m") + 1]
    place = ROOT / module.replace(".", "/")
    assert module in ("pytest",) or place.with_suffix(".py").is_file() or (place / "__main__.py").is_file(), told
