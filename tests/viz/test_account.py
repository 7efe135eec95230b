"""What a review reads stands in the recording as it was on the bus: not rounded, not thinned out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun")

from common.messages import FRAME_S
from evaluation.review.recording import load
from tests.viz import synthetic
from tests.viz.reading import record
from viz.account import HORIZONS_S

FRAMES = 15


@pytest.fixture(scope="module")
def drive() -> synthetic.Drive:
    return synthetic.Drive(angle=0.6, rows=160, columns=40, h=0.8, x0=612_345.0, y0=5_812_345.0)


@pytest.fixture(scope="module")
def heard(drive) -> list:
    return list(synthetic.messages(drive, FRAMES))


@pytest.fixture(scope="module")
def kept(drive, tmp_path_factory: pytest.TempPathFactory):
    return load(record(tmp_path_factory.mktemp("viz") / "drive.rrd", drive, FRAMES, ego_hz=5.0, heavy_hz=5.0))


def of(heard: list, topic: str) -> list:
    return [stamped for name, stamped in heard if name.split("/")[0] == topic]


def test_every_state_of_the_ego_is_kept_exactly_however_rarely_it_is_drawn(kept, heard) -> None:
    sent = [s.value for s in of(heard, "ego")]
    assert len(kept.ego.t) == len(sent)
    for name in ("x", "y", "heading", "vx", "vy", "acceleration", "yaw_rate"):
        assert np.array_equal(getattr(kept.ego, name), [getattr(e, name) for e in sent])
    assert kept.size == (sent[0].length, sent[0].width)


def test_everyone_perceived_is_kept_in_every_frame(kept, heard) -> None:
    sent = [s.value for s in of(heard, "objects")]
    assert len(kept.seen) == len(sent)
    for seen, objects in zip(kept.seen, sent, strict=True):
        for name in ("id", "cls", "x", "y"):
            assert np.array_equal(getattr(seen, name), getattr(objects, name))
        for name in ("heading", "vx", "vy", "length", "width"):
            assert np.allclose(getattr(seen, name), getattr(objects, name), rtol=1e-6)


def test_predictions_are_kept_at_each_horizon(kept, heard) -> None:
    sent = [s.value for s in of(heard, "prediction")]
    frames = [round(h / FRAME_S) - 1 for h in HORIZONS_S]
    assert len(kept.foreseen) == len(sent)
    for foreseen, p in zip(kept.foreseen, sent, strict=True):
        assert np.array_equal(foreseen.id, p.id) and np.array_equal(foreseen.method, p.method)
        assert np.allclose(foreseen.dx, p.x[:, frames] - p.x0[:, None], atol=1e-4)
        assert np.allclose(foreseen.dy, p.y[:, frames] - p.y0[:, None], atol=1e-4)


def test_every_plan_keeps_its_words_and_what_decided(kept, heard) -> None:
    sent = of(heard, "plan")
    assert len(kept.plans) == len(sent)
    for spoken, stamped in zip(kept.plans, sent, strict=True):
        assert spoken.said.mode == stamped.value.mode and spoken.said.reason == stamped.value.reason
        assert spoken.said.decision == stamped.value.decision
        assert spoken.received - spoken.t == pytest.approx((stamped.received_ns - stamped.capture_ns) * 1e-9, abs=1e-6)
        assert spoken.work_ms == pytest.approx(stamped.work_ns * 1e-6)


def test_statuses_are_kept_whole(kept, heard) -> None:
    sent = of(heard, "status")
    assert sum(len(said) for said in kept.statuses.values()) == len(sent)
    last = {s.value.service: s.value for s in sent}
    assert {name: said[-1][1] for name, said in kept.statuses.items()} == last


def test_times_are_those_of_the_contents(kept, heard) -> None:
    sent = of(heard, "objects")
    step = np.diff([s.capture_ns for s in sent]) * 1e-9
    assert np.allclose(np.diff([seen.t for seen in kept.seen]), step, atol=1e-6)
    assert {round(f.t, 6) for f in kept.foreseen} <= {round(s.t, 6) for s in kept.seen}


def test_the_account_is_small(kept, drive, tmp_path: Path) -> None:
    whole = record(tmp_path / "drive.rrd", drive, FRAMES).stat().st_size
    from rerun.chunk import RrdReader

    account = sum(
        c.to_record_batch().nbytes for c in RrdReader(tmp_path / "drive.rrd").stream().filter(content="/account/**")
    )
    assert account / FRAMES < 8 * 1024  # bytes a frame, before compression
    assert account < 0.5 * whole
