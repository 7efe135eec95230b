# ruff: noqa: C408
"""The kernels against the NumPy reference on random small scenes: value, rounding, and the source named."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from common.geometry import distance_to_rectangle
from common.messages import BLOCK, NO_SLOT, Closures
from common.risk import RiskParameters, dynamic_energy, potential_energy, taper
from common.risk_sources import dynamic_sources, risk_at_points, shares_at_points
from services.riskfield import kernels, layout
from services.riskfield.core import RiskField
from services.riskfield.grid import cell_centres
from services.riskfield.selection import left_out
from services.riskfield.settings import RiskfieldSettings
from services.riskfield.static_layer import StaticLayer
from tests.riskfield.scenes import random_scene, stamped

SMALL = dict(ahead=24.0, ahead_most=24.0, behind=16.0, width=20.0, h=0.5, slices=2, slice_s=1.3)


@pytest.fixture(scope="module")
def risk():
    return RiskParameters()


@pytest.fixture(scope="module")
def field(risk):
    return RiskField(RiskfieldSettings(dtype="float32", accuracy="exact", **SMALL), risk, "cpu")


def reference(scene, r, closures, t_offset, p, *, whole=False):
    """Every source's share at every cell: {(id, term, line index or None): [slice, i, j]}.

    Unless `whole`, the kinetic term is evaluated only at cells one width from the piece of the path that it may cover,
    which spares most of the time.
    """
    prediction, ego, road = scene
    sources = dynamic_sources(prediction, np.array(r.slice_times) + t_offset, (ego.vx, ego.vy), p)
    counts, _ = left_out(sources, ego)
    lines = StaticLayer(road, p).within(r.grid, closures.ids, ego)
    X, Y = cell_centres(r.grid)
    found = {}
    for i in np.flatnonzero(counts):
        shares = [shares_of(X, Y, sources, i, j, p, whole) for j in range(len(r.slice_times))]
        for k, term in enumerate(("potential", "kinetic")):
            found[int(sources.id[i]), term, None] = np.stack([s[k] for s in shares])
    nobody = dataclasses.replace(sources, id=sources.id[:0])
    static = shares_at_points(X, Y, nobody, 0, lines, p).static
    for k, line in enumerate(lines):
        found[line.id, "static", k] = np.broadcast_to(static[k], r.volume.shape)
    return found or {(0, "none", None): np.zeros(r.volume.shape)}


def shares_of(X, Y, sources, i, j, p, whole):
    """Potential and kinetic energy of object i in slice j at points."""
    x, y, u, length, width = (float(getattr(sources, k)[j, i]) for k in ("x", "y", "u", "length", "width"))
    heading, M_v, s0 = (float(getattr(sources, k)[j, i]) for k in ("heading", "M_v", "s0"))
    D = distance_to_rectangle(X, Y, x, y, heading, length, width)
    pE, kE = potential_energy(D, M_v, p) * taper(D, p), np.zeros_like(X)
    near = np.full(X.shape, True)
    if not whole:
        reach = length / 2 + width + abs(u) * p.t
        s = np.arange(s0 - reach, s0 + reach + 1.0)
        path = sources.paths.at(np.repeat(s[:, None], len(sources.id), axis=1))[:, i]
        dx = (X - x)[..., None].astype(np.float32) - (path[:, 0] - x).astype(np.float32)
        dy = (Y - y)[..., None].astype(np.float32) - (path[:, 1] - y).astype(np.float32)
        near = np.min(dx * dx + dy * dy, axis=-1) <= (width + 0.6) ** 2
    kE[near] = dynamic_energy(
        X[near], Y[near], x=x, y=y, heading=heading, length=length, width=width, M_v=M_v, u=u, path=sources.path(i),
        s0=s0, p=p,
    )[1]  # fmt: skip
    return pE, kE


def scene_of(seed):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, origin=(0.0, 0.0) if seed % 2 else (6.9e5, 5.3e6))
    return scene, Closures(ids=[[9], [7], []][seed % 3]), float(rng.choice([0.0, 0.23, 0.5]))


def check_exact(field, p, seeds):
    for seed in seeds:
        scene, closures, t_offset = scene_of(seed)
        r = field.step(stamped(scene[0]), stamped(scene[1]), scene[2], closures, t_offset)
        assert r.problem() == ""
        shares = reference(scene, r, closures, t_offset, p)
        ref = np.sum(list(shares.values()), axis=0)
        error = np.abs(r.volume - ref) / (p.e_max + np.abs(ref))
        assert error.max() <= 1e-4, f"seed {seed}: {error.max()} at {np.unravel_index(error.argmax(), error.shape)}"
        check_dominant(r, shares, ref, seed)


def check_dominant(r, shares, ref, seed):
    """Where a block names a source, it has the largest share at the block's highest cell, up to rounding."""
    blocks = [(j, bi, bj) for j in range(ref.shape[0]) for bi in range(0, 20, 3) for bj in range(10)]
    by_name = {}
    for (id, term, _), share in shares.items():
        by_name.setdefault((id, term), []).append(share)
    for j, bi, bj in blocks:
        cells = np.s_[j, BLOCK * bi : BLOCK * bi + BLOCK, BLOCK * bj : BLOCK * bj + BLOCK]
        near_top = ref[cells] >= ref[cells].max() - 1e-4
        largest = np.max([s[cells] for s in shares.values()], axis=0)
        slot = r.dominant[j, bi, bj]
        if slot == NO_SLOT:
            assert largest[near_top].min() <= 1e-6, f"seed {seed}: block {j, bi, bj} names nothing"
            continue
        named = by_name[r.slots[slot].id, r.slots[slot].term]
        best = np.max([s[cells] for s in named], axis=0)
        assert np.any(best[near_top] >= largest[near_top] - 1e-4), f"seed {seed}: block {j, bi, bj}: {r.slots[slot]}"


@pytest.mark.long
def test_kernels_equal_the_reference_on_random_scenes(field, risk):
    check_exact(field, risk, range(200))


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_kernels_equal_the_reference_on_ten_thousand_random_scenes(field, risk):
    for first in range(200, 10200, 200):
        check_exact(field, risk, range(first, first + 200))
        print(f"seeds {first} to {first + 199} agree", flush=True)


def test_the_reference_of_these_tests_is_that_of_the_equations(field, risk):
    for seed in range(6):
        (prediction, ego, road), closures, t_offset = scene = scene_of(seed)
        r = field.step(stamped(prediction), stamped(ego), road, closures, t_offset)
        cut, whole = (sum(reference(scene[0], r, closures, t_offset, risk, whole=w).values()) for w in (False, True))
        sources = dynamic_sources(prediction, np.array(r.slice_times) + t_offset, (ego.vx, ego.vy), risk)
        lines = StaticLayer(road, risk).within(r.grid, closures.ids, ego)
        if left_out(sources, ego)[0].all():
            X, Y = cell_centres(r.grid)
            M = np.stack([risk_at_points(X, Y, sources, j, lines, risk) for j in range(len(r.slice_times))])
            assert np.allclose(whole, M, rtol=0, atol=1e-12)
        assert np.array_equal(cut, whole)


@pytest.mark.parametrize("k1", [1.0, 3.0])
def test_kernels_equal_the_reference_for_other_powers_of_the_distance(k1):
    p = RiskParameters(k1=k1, k=5e-4, taper_radius=15.0, t=2.0, d0=0.5, E_k=0.7, e_max=2.0)
    check_exact(RiskField(RiskfieldSettings(dtype="float32", accuracy="exact", **SMALL), p, "cpu"), p, range(8))


def test_float16_is_the_float32_volume_rounded(field, risk):
    half = RiskField(RiskfieldSettings(dtype="float16", **SMALL), risk, "cpu")
    for seed in range(12):
        scene, closures, t_offset = scene_of(seed)
        args = stamped(scene[0]), stamped(scene[1]), scene[2], closures, t_offset
        a, b = field.step(*args), half.step(*args)
        assert b.volume.dtype == np.float16
        expected = a.volume.astype(np.float16)
        # below 2⁻¹⁴ float16 has a fixed step, which flushed denormals may miss
        assert np.all((b.volume == expected) | (np.abs(b.volume.astype(np.float32) - a.volume) < 6.2e-5))
        assert np.array_equal(a.dominant, b.dominant)


def test_the_fast_variant_stays_within_two_thousandths_of_e_max(risk):
    """Two levels: from the nodes far off, exact near every body; on all cells, against the exact variant."""
    layout = SMALL | dict(h=0.25)
    exact, fast = (
        RiskField(RiskfieldSettings(dtype="float32", accuracy=a, **layout), risk, "cpu") for a in ("exact", "fast")
    )
    differs = 0.0
    for seed in range(60):
        scene, closures, t_offset = scene_of(seed)
        args = stamped(scene[0]), stamped(scene[1]), scene[2], closures, t_offset
        a, b = exact.step(*args), fast.step(*args)
        error = np.abs(a.volume - b.volume).max()
        assert error <= 2e-3 * risk.e_max, f"seed {seed}: {error}"
        assert b.volume.min() >= 0.0
        differs = max(differs, error)
    assert differs > 1e-6  # they are two variants


def test_threads_share_the_slices_and_change_nothing(field, risk):
    two = RiskField(RiskfieldSettings(dtype="float32", threads=2, **SMALL), risk, "cpu")
    scene, closures, t_offset = scene_of(5)
    args = stamped(scene[0]), stamped(scene[1]), scene[2], closures, t_offset
    assert np.array_equal(two.step(*args).volume, field.step(*args).volume)


def test_a_frame_leaves_the_earlier_messages_alone(field):
    (p, e, m), closures, _ = scene_of(3)
    first = field.step(stamped(p), stamped(e), m, closures)
    kept = first.volume.copy(), first.dominant.copy()
    (p, e, m), closures, _ = scene_of(4)
    field.step(stamped(p), stamped(e), m, closures)
    assert np.array_equal(first.volume, kept[0])
    assert np.array_equal(first.dominant, kept[1])


def test_wide_grids_are_computed_in_several_runs(risk):
    wide = RiskfieldSettings(
        ahead=10, ahead_most=10, behind=10, width=160, h=0.25, slices=2, dtype="float32", accuracy="exact"
    )
    assert wide.width / wide.h > layout.CPU_RUN
    narrow = RiskField(wide, risk, "cpu")
    scene, closures, t_offset = scene_of(11)
    r = narrow.step(stamped(scene[0]), stamped(scene[1]), scene[2], closures, t_offset)
    ref = np.sum(list(reference(scene, r, closures, t_offset, risk).values()), axis=0)
    assert np.abs(r.volume - ref).max() <= 1e-4 * (1 + ref.max())


def test_the_printed_kinetic_term_is_computed_too():
    """Compared away from its poles and its edges, where it has no continuity to compare."""
    p = RiskParameters(kinetic="paper")
    field = RiskField(RiskfieldSettings(dtype="float32", accuracy="exact", **SMALL), p, "cpu")
    for seed in range(8):
        scene, closures, t_offset = scene_of(seed)
        r = field.step(stamped(scene[0]), stamped(scene[1]), scene[2], closures, t_offset)
        ref = np.sum(list(reference(scene, r, closures, t_offset, p).values()), axis=0)
        assert np.all(np.isfinite(r.volume))
        assert np.mean(np.abs(r.volume - ref) > 1e-4 * (1 + ref)) < 1e-3


@pytest.mark.long
def test_the_kernels_compile_for_cuda_without_a_gpu(tmp_path):
    import warp as wp

    wp.init()
    made = wp.compile_aot_module(kernels.field_kernel.module, arch=[75, 90], module_dir=tmp_path)
    assert len([f for f in made if f.suffix in (".ptx", ".cubin")]) >= 2
    assert all(f.stat().st_size > 1000 for f in made)
