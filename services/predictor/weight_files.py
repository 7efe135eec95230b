"""Weights as files: `model.json` says what there is, one safetensors file a network, each with its hash.

A folder of weights is refused as a whole if its card cannot be read, and a network if its file is missing, its SHA-256
differs from the card's, its architecture is unknown, or names, shapes and types of its tensors are not the ones the
architecture asks for. Nothing is unpickled.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from common.messages import F64, PREDICTION_FRAMES, ObjectClass
from services.predictor.lstm import Architecture, Network

CARD = "model.json"
SHIPPED = Path(__file__).with_name("weights")
SCHEMA = 1
BYTES_MAX = 16 * 2**20
"""Largest file that is read [bytes]."""
HIDDEN_MAX = 1024
SHARE = 0.683
"""Share of positions within the spread."""
SPREAD_FRAMES = tuple(range(5, PREDICTION_FRAMES + 1, 5))
"""Frames at which the card gives the spread; linear between them, from 0 now."""


class WeightsError(ValueError):
    """Weights that are not used: the file and the reason."""


@dataclass(frozen=True)
class Loaded:
    """One network, ready for inference."""

    name: str
    network: Network
    shrink: tuple[float, float]
    """The deviation from constant velocity is taken times this, slow and fast (`features.shrinkage`)."""
    classes: frozenset[ObjectClass]
    """The class rule: who may be predicted with it."""
    spread: F64 | None = None
    """Radius about the predicted position [m] that held `SHARE` of the held-out recordings' positions, shape [60]."""


def read_card(folder: Path) -> dict[str, Any]:
    """The card of a folder of weights.

    Raises:
        WeightsError: it is missing, not JSON, or of another schema.
    """
    path = folder / CARD
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as e:
        raise WeightsError(f"{path}: {e}") from None
    if not isinstance(card, dict) or card.get("schema") != SCHEMA or not isinstance(card.get("networks"), dict):
        raise WeightsError(f"{path}: not a card of schema {SCHEMA}")
    return card


def load(folder: Path, name: str = "") -> Loaded:
    """A network of a folder; without a name the card's default.

    Raises:
        WeightsError: which file, and why it is refused.
    """
    card = read_card(folder)
    name = name or str(card.get("default", ""))
    entry = card["networks"].get(name)
    if not isinstance(entry, dict):
        raise WeightsError(f"{folder / CARD}: no network {name!r}; there are {', '.join(card['networks'])}")
    try:
        architecture = _architecture(entry["architecture"])
        file, expected = folder / Path(str(entry["file"])).name, str(entry["sha256"])
        slow, fast = (float(s) for s in entry["shrink"])
        classes = frozenset(ObjectClass[str(c).upper()] for c in card["classes"])
        spread = _spread(entry.get("spread"))
    except (KeyError, TypeError, ValueError) as e:
        raise WeightsError(f"{folder / CARD}: {name}: {type(e).__name__}: {e}") from None
    if not (0.0 <= slow <= 1.0 and 0.0 <= fast <= 1.0):
        raise WeightsError(f"{folder / CARD}: {name}: shrink {slow}, {fast}")
    network = Network(architecture)
    network.load_state_dict(_checked(file, expected, network))
    return Loaded(name, network.eval().requires_grad_(False), (slow, fast), classes, spread)


def save(folder: Path, name: str, network: Network) -> dict[str, Any]:
    """Write a network's file and return its entry in the card (without `shrink`)."""
    state = {k: v.detach().to("cpu", torch.float32).contiguous() for k, v in network.state_dict().items()}
    data = save_tensors(state)
    file = f"{name}.safetensors"
    draft = folder / f".{file}"
    draft.write_bytes(data)
    draft.replace(folder / file)
    return {
        "file": file,
        "sha256": hashlib.sha256(data).hexdigest(),
        "bytes": len(data),
        "architecture": network.architecture.as_dict(),
    }


def _spread(radii: object) -> F64 | None:
    """Radius at each frame from the card's values at `SPREAD_FRAMES`; None where it has none."""
    if radii is None:
        return None
    known = np.asarray(radii, dtype=np.float64)
    if known.shape != (len(SPREAD_FRAMES),) or not (np.isfinite(known).all() and (known >= 0).all()):
        raise ValueError(f"a spread of {radii}")
    return np.asarray(np.interp(np.arange(1, PREDICTION_FRAMES + 1), (0, *SPREAD_FRAMES), (0.0, *known)))


def _architecture(values: Mapping[str, Any]) -> Architecture:
    known = {f.name for f in fields(Architecture)}
    if set(values) != known:
        raise ValueError(f"an architecture of {sorted(values)}, this code knows {sorted(known)}")
    chosen = Architecture(**values)
    switches = (chosen.risk, chosen.attention, chosen.leader)
    if chosen.form not in ("paper", "residual") or not all(isinstance(s, bool) for s in switches):
        raise ValueError(f"an architecture of {values}")
    if not isinstance(chosen.hidden, int) or not 1 <= chosen.hidden <= HIDDEN_MAX:
        raise ValueError(f"hidden {chosen.hidden}")
    return chosen


def _checked(file: Path, expected: str, network: Network) -> dict[str, torch.Tensor]:
    try:
        if file.stat().st_size > BYTES_MAX:
            raise WeightsError(f"{file}: larger than {BYTES_MAX} bytes")
        data = file.read_bytes()
    except OSError as e:
        raise WeightsError(f"{file}: {e}") from None
    digest = hashlib.sha256(data).hexdigest()
    if digest != expected:
        raise WeightsError(f"{file}: SHA-256 {digest[:12]}…, the card says {expected[:12]}…")
    try:
        tensors: dict[str, torch.Tensor] = load_tensors(data)
    except (SafetensorError, ValueError) as e:
        raise WeightsError(f"{file}: not safetensors: {e}") from None
    wanted = network.state_dict()
    if set(tensors) != set(wanted):
        different = sorted(set(tensors) ^ set(wanted))
        raise WeightsError(f"{file}: of another architecture: {', '.join(different[:4])}")
    for name, tensor in tensors.items():
        if tensor.shape != wanted[name].shape or tensor.dtype != wanted[name].dtype:
            raise WeightsError(f"{file}: {name} is {tensor.dtype} {list(tensor.shape)}: another architecture")
        if not bool(torch.isfinite(tensor).all()):
            raise WeightsError(f"{file}: {name} is not finite")
    return tensors
