"""The codec alone in a process of its own: how long it takes for each message, and what it does to memory.

`python -m evaluation.faults.decoding fuzz|bombs TOPIC COUNT SEED` prints one line of JSON.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from common import codec
from common.codec import RefusedError
from common.topics import TOPICS, Topic
from evaluation.faults.fuzz import Attack, Fuzzer, bombs
from evaluation.faults.result import FaultError

MIB = 2**20
WARM_UP = 500


def fuzzed(topic: Topic, count: int, seed: int) -> dict[str, Any]:
    """Decode so many fuzzed messages one by one; those of the warm-up count, but not for memory."""
    fuzzer = Fuzzer(topic, seed)
    outcomes: Counter[str] = Counter()
    kinds: Counter[str] = Counter()
    times, work = np.zeros(count), np.zeros(count)
    before = 0
    for i in range(count):
        if i == min(WARM_UP, count // 2):
            gc.collect()
            before = resident()
        attack = fuzzer.next(i)
        kinds[attack.kind] += 1
        begin, worked = time.perf_counter(), time.thread_time()
        outcomes[outcome(topic, attack)] += 1
        times[i], work[i] = time.perf_counter() - begin, time.thread_time() - worked
    gc.collect()
    return {
        "outcomes": outcomes, "kinds": kinds, "p99_ms": float(np.percentile(times, 99)) * 1e3,
        "p99_cpu_ms": float(np.percentile(work, 99)) * 1e3,
        "max_ms": float(times.max()) * 1e3, "grown_mib": (resident() - before) / MIB,
    }  # fmt: skip


def exploded(topic: Topic) -> dict[str, Any]:
    """Decode every bomb; the highest memory that one takes beyond its own bytes, above what was there before."""
    outcomes: Counter[str] = Counter()
    worst, name, accepted = 0.0, "", []
    for bomb in bombs(topic):
        gc.collect()
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before = resident()
        found = outcome(topic, bomb)
        peak = (resident("VmHWM") - before) / MIB
        outcomes[found] += 1
        if found == "accepted":
            accepted.append(bomb.kind)
        if peak > worst:
            worst, name = peak, bomb.kind
    return {"outcomes": outcomes, "peak_mib": worst, "worst": name, "accepted": accepted}


def outcome(topic: Topic, attack: Attack) -> str:
    """The counter it raises, `accepted`, or what escaped."""
    try:
        codec.decode_body(topic, codec.decode_header(topic, attack.attachment), attack.payload)
    except RefusedError as e:
        return e.reason
    except Exception as e:  # what the codec promises never to let out
        return f"escaped {type(e).__name__}: {str(e)[:80]}"
    return "accepted"


def resident(what: str = "VmRSS", pid: int | str = "self") -> int:
    """Memory of a process [bytes]: `VmRSS` now, `VmHWM` at its peak."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split(f"{what}:")[1].split()[0]) * 1024


def alone(mode: str, topic: Topic, count: int, seed: int) -> dict[str, Any]:
    """Run one of the above in a process of its own.

    Raises:
        FaultError: it died.
    """
    command = [sys.executable, "-P", "-m", "evaluation.faults.decoding", mode, topic.suffix, str(count), str(seed)]
    root = str(Path(__file__).parents[2])
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=root,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))},
    )  # fmt: skip
    if done.returncode:
        raise FaultError(f"decoding {topic.suffix} ended with code {done.returncode}: {done.stderr[-400:]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def main(arguments: list[str]) -> int:
    """See above."""
    mode, suffix, count, seed = arguments
    topic = TOPICS[suffix]
    print(json.dumps(fuzzed(topic, int(count), int(seed)) if mode == "fuzz" else exploded(topic)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
