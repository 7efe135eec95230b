"""Which source each block names: from the kernels' codes to the message's slots, within the header's bytes."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from common.messages import NO_SLOT, U8, LeftOut, Slot

MOST_SLOTS = 254
"""Slots of named sources; one more may say `other`."""
HEADER_BYTES = 8 * 1024
ENVELOPE_BYTES = 1200
"""Room for the rest of the header: the largest names, numbers, grid, array descriptions, and the step's inputs."""
LEFT_OUT_BYTES = 1200
OTHER_ID = -1
"""Id of the slot `other` and of the entry that counts what no longer fits."""


def within_bytes(left_out: list[LeftOut]) -> list[LeftOut]:
    """As many of the left-out sources as the header takes; a last entry counts the rest."""
    kept: list[LeftOut] = []
    room = LEFT_OUT_BYTES - 40
    for entry in left_out:
        room -= _size(entry)
        if room < 0:
            return [*kept, LeftOut(id=OTHER_ID, reason=f"and {len(left_out) - len(kept)} more")]
        kept.append(entry)
    return kept


def assign_slots(
    codes: npt.NDArray[np.int32], names: list[Slot], *, other_bytes: int
) -> tuple[list[Slot], U8, list[LeftOut]]:
    """Give slots to the sources that some block names, the most frequent first.

    Args:
        codes: Source of each block, an index into `names`, −1: none; any shape.
        names: What each code stands for.
        other_bytes: Bytes of the header that are taken by slice times and left-out sources.

    Returns:
        The slots, `dominant` with the shape of `codes`, and an entry that says how many sources share the slot
        `other`, if there is one.
    """
    blocks = np.bincount(codes.ravel() + 1, minlength=len(names) + 1)[1:]
    used = np.flatnonzero(blocks)
    used = used[np.argsort(-blocks[used], kind="stable")]
    room = HEADER_BYTES - ENVELOPE_BYTES - other_bytes - 64
    table = np.full(len(names) + 1, NO_SLOT, dtype=np.uint8)
    slots: list[Slot] = []
    for rank, code in enumerate(used):
        room -= _size(names[code])
        if len(slots) == MOST_SLOTS or room < 0:
            table[used[rank:] + 1] = len(slots)
            rest = len(used) - rank
            slots.append(Slot(id=OTHER_ID, term=names[code].term, cls=-1, label="other"))
            return slots, table[codes + 1], [LeftOut(id=OTHER_ID, reason=f"{rest} sources share slot other")]
        table[code + 1] = len(slots)
        slots.append(names[code])
    return slots, table[codes + 1], []


def _size(entry: Slot | LeftOut) -> int:
    return len(msgspec.msgpack.encode(entry))
