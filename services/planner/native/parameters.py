"""Arguments of a native loop: one declaration makes the C++ structure and the one that is filled in.

What is handed over is the structure's address, and that of its arrays within it: building the array objects of Warp
would take longer than the loops do.
"""

from __future__ import annotations

import ctypes
import re
from typing import Any

import numpy as np
import numpy.typing as npt

_MEMBER = re.compile(r"^\s*(?:const )?(int|float|double|unsigned char|void)(\*?) (\w+);", re.MULTILINE)
_TYPES = {"int": ctypes.c_int, "float": ctypes.c_float, "double": ctypes.c_double}
_DTYPES = {
    "int": np.dtype(np.int32),
    "float": np.dtype(np.float32),
    "double": np.dtype(np.float64),
    "unsigned char": np.dtype(np.uint8),
}


class Parameters(ctypes.Structure):
    """Base of what `structure` makes."""

    cpp: str
    dtypes: dict[str, Any]

    def __init__(self, **values: Any) -> None:
        super().__init__()
        self.kept: list[npt.NDArray[Any]] = []
        self.fill(**values)

    def fill(self, **values: Any) -> None:
        """Set members by name; of an array its address, copied first only if type or order are not the declared."""
        kinds = self.dtypes
        for name, value in values.items():
            if name in kinds:
                kind = kinds[name]
                if not (value.flags.c_contiguous and (kind is None or value.dtype is kind)):
                    value = np.ascontiguousarray(value, dtype=kind)
                self.kept.append(value)  # alive as long as this is
                value = value.ctypes.data
            setattr(self, name, value)

    @property
    def address(self) -> int:
        """Where it lies."""
        return ctypes.addressof(self)


def structure(name: str, declaration: str) -> type[Parameters]:
    """Declare `type name;` line by line: int, float, double, or pointers to these, unsigned char and void."""
    members = _MEMBER.findall(declaration)
    fields = [(member, ctypes.c_uint64 if pointer else _TYPES[kind]) for kind, pointer, member in members]
    dtypes = {member: _DTYPES.get(kind) for kind, pointer, member in members if pointer}
    cpp = f"struct {name} {{{declaration}}}; const {name}& p = *(const {name}*)address;\n"
    return type(name, (Parameters,), {"_fields_": fields, "cpp": cpp, "dtypes": dtypes})
