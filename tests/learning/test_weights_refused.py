"""Weights are checked before they are used; without good ones the service runs on kinematic and says so."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest
import torch
from safetensors.torch import save as save_tensors

from common.health import Health
from common.messages import Method, Objects, Stamped
from common.risk import RiskParameters
from services.predictor.core import Predictor
from services.predictor.learned import load_learned
from services.predictor.lstm import Architecture, Network
from services.predictor.settings import LearnedSettings, PredictorSettings
from services.predictor.weight_files import CARD, SCHEMA, SHIPPED, WeightsError, load, read_card, save


@pytest.fixture
def folder(tmp_path):
    torch.manual_seed(0)
    entry = save(tmp_path, "lstm", Network(Architecture(hidden=8)))
    write(tmp_path, {**entry, "shrink": [1.0, 0.5]})
    return tmp_path


def write(folder, entry, **more):
    card = {"schema": SCHEMA, "default": "lstm", "classes": ["car", "bus"], "networks": {"lstm": entry}, **more}
    (folder / CARD).write_text(json.dumps(card))


def entry_of(folder):
    return read_card(folder)["networks"]["lstm"]


def replaced(folder, tensors):
    data = save_tensors(tensors)
    (folder / "lstm.safetensors").write_bytes(data)
    write(folder, {**entry_of(folder), "sha256": hashlib.sha256(data).hexdigest()})


def test_weights_come_back_as_they_were_saved(folder):
    loaded = load(folder)
    torch.manual_seed(0)
    for a, b in zip(loaded.network.parameters(), Network(Architecture(hidden=8)).parameters(), strict=True):
        assert torch.equal(a, b)
    assert loaded.shrink == (1.0, 0.5) and {c.name for c in loaded.classes} == {"CAR", "BUS"}


def test_one_changed_byte_is_refused(folder):
    data = bytearray((folder / "lstm.safetensors").read_bytes())
    data[-3] ^= 1
    (folder / "lstm.safetensors").write_bytes(bytes(data))
    with pytest.raises(WeightsError, match="SHA-256"):
        load(folder)


def test_another_architecture_is_refused(folder):
    entry = entry_of(folder)
    write(folder, {**entry, "architecture": {**entry["architecture"], "hidden": 16}})
    with pytest.raises(WeightsError, match="another architecture"):
        load(folder)
    write(folder, {**entry, "architecture": {**entry["architecture"], "attention": False}})
    with pytest.raises(WeightsError, match="another architecture"):
        load(folder)
    write(folder, {**entry, "architecture": {**entry["architecture"], "layers": 2}})
    with pytest.raises(WeightsError, match="architecture"):
        load(folder)


def test_weights_that_are_not_finite_or_not_safetensors_are_refused(folder):
    state = {k: v.clone() for k, v in Network(Architecture(hidden=8)).state_dict().items()}
    state["head.bias"][0] = float("nan")
    replaced(folder, state)
    with pytest.raises(WeightsError, match="finite"):
        load(folder)
    data = b"\x80\x04pickle"
    (folder / "lstm.safetensors").write_bytes(data)
    write(folder, {**entry_of(folder), "sha256": hashlib.sha256(data).hexdigest()})
    with pytest.raises(WeightsError, match="not safetensors"):
        load(folder)


@pytest.mark.parametrize("card", ["", "[]", "{}", '{"schema": 99, "networks": {}}', "\udcff"])
def test_a_card_that_is_none_is_refused(tmp_path, card):
    (tmp_path / CARD).write_text(card, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(WeightsError):
        load(tmp_path)


def test_a_file_outside_the_folder_is_not_followed(folder):
    write(folder, {**entry_of(folder), "file": "../../etc/passwd"})
    with pytest.raises(WeightsError, match=str(folder)):
        load(folder)


def objects(k):
    one = np.array([0.0])
    return Stamped(
        Objects(id=np.array([5]), cls=np.array([1], np.uint8), x=np.array([1.0 * k]), y=one, heading=one,
                vx=np.array([10.0]), vy=one, length=one + 4.5, width=one + 1.8, mass=one),
        10**9 + k * 10**8, 10**9 + k * 10**8)  # fmt: skip


def test_refused_weights_leave_the_service_on_kinematic_and_it_says_so(folder):
    from services.predictor.__main__ import build

    (folder / "lstm.safetensors").write_bytes(b"something else")
    settings = PredictorSettings(policy="learned-first", learned=LearnedSettings(weights=str(folder)))
    learned, said = load_learned(settings, RiskParameters())
    assert learned is None and "SHA-256" in said
    predictor = Predictor(settings, RiskParameters(), learned)
    for k in range(31):
        prediction = predictor.step(objects(k), None, None)
    assert prediction.method[0] == Method.CONSTANT_VELOCITY
    health = Health.__new__(Health)
    health.detail = {}
    build({"predictor": {"policy": "learned-first", "learned": {"weights": str(folder)}}}, health)
    assert "refused" in health.detail["network"]


def test_good_weights_are_used_from_thirty_frames_on_and_only_for_their_classes(folder):
    settings = PredictorSettings(policy="learned-first", learned=LearnedSettings(weights=str(folder)))
    learned, said = load_learned(settings, RiskParameters())
    assert said == "lstm"
    predictor = Predictor(settings, RiskParameters(), learned)
    methods = [int(predictor.step(objects(k), None, None).method[0]) for k in range(32)]
    assert methods[28] == Method.CONSTANT_VELOCITY and methods[30] == Method.LSTM


def test_a_spread_is_told_only_when_asked_and_only_of_learned_predictions(folder):
    write(folder, {**entry_of(folder), "spread": [0.1 * k for k in range(1, 13)]})
    for asked in (False, True):
        settings = PredictorSettings(policy="learned-first", learned=LearnedSettings(weights=str(folder), spread=asked))
        predictor = Predictor(settings, RiskParameters(), load_learned(settings, RiskParameters())[0])
        told = [predictor.step(objects(k), None, None).sigma for k in range(32)]
        if not asked:
            assert told == [None] * 32
            continue
        assert not told[10].any()
        np.testing.assert_allclose(told[31][0], 0.02 * np.arange(1, 61), rtol=1e-5)


@pytest.mark.parametrize("spread", [[1.0], "wide", [float("nan")] * 12, [-1.0] * 12])
def test_a_spread_that_is_none_is_refused(folder, spread):
    write(folder, {**entry_of(folder), "spread": spread})
    with pytest.raises(WeightsError, match="lstm"):
        load(folder)


def test_the_shipped_weights_are_small_whole_and_of_open_data():
    card = read_card(SHIPPED)
    for name in card["networks"]:
        spread = load(SHIPPED, name).spread
        assert spread is not None and (np.diff(spread) > 0).all()
    assert sum(f.stat().st_size for f in SHIPPED.iterdir()) <= 2 * 2**20
    assert set(card["tables"]) == {"ngsim_lankershim.csv.gz", "ngsim_us101.csv.gz", "traffic.csv.gz"}
    assert not any("sind" in s or "av2" in s or "nuscenes" in s for s in card["data"]["recorded_sites"])
