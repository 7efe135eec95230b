"""The riskfield with an injected fault: `python -m evaluation.faults.faulty_riskfield KIND STEPS`.

`gpu`: after so many steps the device fails as CUDA does, with an error that stays; `build`: the kernels do not compile;
`nan`: after so many steps the kernel writes what is no number. All else is the service itself.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from common.service import main
from services.riskfield import __main__ as service
from services.riskfield.core import RiskField
from services.riskfield.device import FieldDevice

MESSAGE = "Warp CUDA error 700: an illegal memory access was encountered (injected)"
BUILD = "Failed to compile module services.riskfield.kernels (injected)"


def inject(kind: str, steps: int) -> None:
    """Put the fault into the classes that the service is about to use."""
    done = 0
    compute = FieldDevice.compute

    def warm_up(self: RiskField) -> None:
        raise RuntimeError(BUILD)

    def failing(self: FieldDevice, *arguments: Any) -> Any:
        nonlocal done
        done += 1
        volume, codes = compute(self, *arguments)
        if done <= steps:
            return volume, codes
        if kind == "gpu":
            raise RuntimeError(MESSAGE)
        broken = np.array(volume)
        broken[0, ::7, ::5] = np.nan
        return broken, codes

    if kind == "build":
        RiskField.warm_up = warm_up  # type: ignore[method-assign]
    else:
        FieldDevice.compute = failing  # type: ignore[method-assign, assignment]
    if kind == "gpu":  # an error of the processor is survived, one of a GPU is not: this one stands for a GPU

        class OnGpu(RiskField):
            def __init__(self, *arguments: Any) -> None:
                super().__init__(*arguments)
                self.device = "cuda:0"

        setattr(service, "RiskField", OnGpu)  # noqa: B010 - it stands there as an import


if __name__ == "__main__":
    inject(sys.argv[1], int(sys.argv[2]))
    raise SystemExit(main(service.SERVICE))
