"""A number for the definitions of the situations: it changes when anybody's motion in them does."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np

from evaluation.hazards.named import Case


def fingerprint(cases: Iterable[Case]) -> str:
    """SHA-256 over names, labels and all motion, positions to a centimetre, headings to 0.01 rad."""
    digest = hashlib.sha256()
    for case in cases:
        e, truth = case.episode, case.truth
        digest.update(f"{e.name} {truth.label} {len(e.actors)} {e.speed:.3f}".encode())
        parts = [np.stack(e.ego_poses(e.times[::50]))]
        parts += [np.stack((a.x[::50], a.y[::50], np.unwrap(a.heading[::50]))) for a in e.actors]
        parts += [np.array([[float(a.cls), a.length, a.width]]) for a in e.actors]
        for part in parts:
            # + 0.0: no negative zero; the offset keeps nominal values away from rounding edges
            digest.update((np.round(part + 0.00123, 2) + 0.0).astype("<f8").tobytes())
    return digest.hexdigest()
