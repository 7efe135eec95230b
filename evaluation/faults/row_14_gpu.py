"""Row 14: the GPU fails, the kernels do not compile, the kernel writes what is no number; a supervisor restarts."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass

from common import topics
from common.bus import Raw
from evaluation.faults.decoding import outcome
from evaluation.faults.faulty_riskfield import BUILD, MESSAGE
from evaluation.faults.fuzz import Attack
from evaluation.faults.result import FaultError, Figure, Row, Say, Scale, Verdict
from evaluation.faults.stack import Stack, stack
from evaluation.faults.watch import until

NUMBER = 14
TARGET = "process exits non-zero, comes back ≤ 15 s, never publishes a broken field"
BACK_S = 15.0
FAULTY = "evaluation.faults.faulty_riskfield"
STEPS = 25
"""Good fields before the fault: they must be published, so that what follows can be told from silence."""


@dataclass
class Fields:
    """What of `risk` was heard: when, of which boot, and what the codec makes of it."""

    heard: list[tuple[int, str]]
    broken: Counter[str]

    def hear(self, raw: Raw) -> None:
        """Judge one."""
        found = outcome(raw.topic, Attack("", raw.attachment, raw.payload))
        if found != "accepted":
            self.broken[found] += 1
        boot = (raw.attachment or b"").partition(b"\xa4boot\xb0")[2][:16].decode()
        self.heard.append((raw.received_ns, boot))

    def since(self, ns: int, not_of: str = "") -> list[tuple[int, str]]:
        """Those after a moment, of another boot than that."""
        return [(t, b) for t, b in self.heard if t > ns and b != not_of]


def run(scale: Scale, seed: int, say: Say) -> Row:
    """Each fault so many times."""
    n = scale.repetitions(2, 30)
    verdict, fields = Verdict(), Fields([], Counter())
    codes: list[int] = []
    backs: list[float] = []
    withheld = 0
    said = Counter[str]()
    with stack(seed=seed, road_users=8) as s:
        s.bus.tap(topics.RISK, fields.hear)
        for i in range(n):
            for kind, words in (("gpu", MESSAGE), ("build", BUILD)):
                code, back = ended(s, fields, kind, words)
                codes.append(code)
                backs.append(back)
                said[kind] += 1
                say(f"{i + 1} of {n}, {kind}: code {code}, a field again after {back:.1f} s")
            withheld += withheld_nan(s, fields)
            said["nan"] += 1
            say(f"{i + 1} of {n}, nan: {withheld} fields withheld so far")
        total = len(fields.heard)
    verdict.need(all(c not in (0, None) for c in codes), f"exit codes {sorted(set(codes))}")
    verdict.need(max(backs) <= BACK_S, f"a field again only after {max(backs):.1f} s")
    verdict.need(not fields.broken, f"broken fields on the bus: {dict(fields.broken)}")
    figures: dict[str, Figure] = {
        "exit codes": ", ".join(map(str, sorted(set(codes)))), "a field again after the exit, worst [s]": max(backs),
        "fields heard and checked": total, "broken fields heard": fields.broken.total(),
        "fields of NaN withheld and counted": withheld,
    }  # fmt: skip
    proof = (
        f"{said['gpu']} GPU errors and {said['build']} failed builds, each with its words in the log; {withheld} NaN"
    )
    fault = (
        f"injected in the riskfield's process, {n}× each: CUDA error 700 in a step, a kernel that does not compile, a"
        " kernel that writes NaN"
    )
    return verdict.row(NUMBER, fault, TARGET, figures, proof)


def ended(s: Stack, fields: Fields, kind: str, words: str) -> tuple[int, float]:
    """Run the riskfield with a fault that ends it, restart it; its exit code, and when there was a field again [s]."""
    s.wait_drive()
    s.terminate("riskfield", 5.0)
    before = time.monotonic_ns()
    s.start(FAULTY, kind, str(STEPS), settings={})
    child = s.lives[FAULTY].child
    try:
        code = child.process.wait(90.0)
    except Exception:
        raise FaultError(f"{kind}: the process did not end; its log ends:\n{child.tail()}") from None
    gone = time.monotonic_ns()
    if words not in child.tail(60):
        raise FaultError(f"{kind}: it ended with code {code}, but not of this fault:\n{child.tail()}")
    of_it = fields.since(before)
    if kind == "gpu" and len(of_it) < STEPS // 2:
        raise FaultError(f"gpu: only {len(of_it)} fields came before the fault")
    if kind == "build" and of_it:
        raise FaultError(f"build: {len(of_it)} fields came of kernels that were never built")
    s._forget(FAULTY)
    s.start("riskfield")  # what `restart:` of compose does, at once
    last = of_it[-1][1] if of_it else ""
    came = until(lambda: fields.since(gone, last), 90.0, "a field of the new process")
    s.wait_up("riskfield")
    s.wait_drive()
    return code, (came[0][0] - gone) * 1e-9


def withheld_nan(s: Stack, fields: Fields) -> int:
    """A kernel that writes NaN: nothing of it may be sent, and the status says so. Returns how many were withheld."""
    s.wait_drive()
    s.terminate("riskfield", 5.0)
    s.start(FAULTY, "nan", str(STEPS))

    def counted() -> int:
        heard = s.watch.status("riskfield")
        return 0 if heard is None or heard.status is None else heard.status.counters.get("risk:not_sent_non_finite", 0)

    until(lambda: counted() >= 5, 90.0, "five withheld fields")
    heard = s.watch.status("riskfield")
    if heard is None or heard.mode != "degraded" or "non_finite" not in heard.reason:
        raise FaultError(f"nan: withheld, but the status says {heard and (heard.mode, heard.reason)}")
    s.watch.mode("safe_stop", heard.arrived_ns - 1_000_000_000, 5.0)
    withheld = counted()
    s.terminate(FAULTY, 5.0)
    s.start("riskfield")
    s.wait_up("riskfield")
    s.wait_drive()
    return withheld
