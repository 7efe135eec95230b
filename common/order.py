"""Which message of a topic may still be used: none twice, none backwards, none of a process that was replaced."""

from __future__ import annotations

from common.codec import RefusedError
from common.messages import Header

MAX_REPLACED = 4096


class Order:
    """Sequence of one topic. Ask `check` with a header, then `accept` it once its body was good too."""

    def __init__(self) -> None:
        self._boot = ""
        self._seq = -1
        self._replaced: dict[str, None] = {}

    def check(self, header: Header) -> None:
        """Raise for what must not be used.

        Raises:
            RefusedError: `old_boot`, `duplicate`, `reordered`.
        """
        if header.boot in self._replaced:
            raise RefusedError("old_boot", f"{header.source} {header.boot} was replaced by {self._boot}")
        if header.boot == self._boot:
            if header.seq == self._seq:
                raise RefusedError("duplicate", f"seq {header.seq}")
            if header.seq < self._seq:
                raise RefusedError("reordered", f"seq {header.seq} after {self._seq}")

    def accept(self, header: Header) -> None:
        """Take a header as the newest of its topic."""
        if header.boot != self._boot and self._boot:
            self._replaced[self._boot] = None
            while len(self._replaced) > MAX_REPLACED:
                self._replaced.pop(next(iter(self._replaced)))
        self._boot, self._seq = header.boot, header.seq
