"""Laws that hold for any values: DOFs and their senses, units, alignment of FRFs, covariance of selections, add and remove, HDF5."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from operando.data import Channel, FrequencyAxis, Frf, Geometry, ModalModel, TimeRecord
from operando.dof import Dof, DofIndex, match_dofs, parse_dofs
from operando.frf import merge_frfs
from operando.io import read_hdf5, write_hdf5
from operando.structure import Model
from operando.units import parse_unit, si_factor

QUICK = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
NUMBERS = st.floats(-1e6, 1e6, allow_nan=False, width=64)
SEEDS = st.integers(0, 2**32 - 1)
DOFS = st.builds(
    Dof, st.integers(1, 10_000), st.sampled_from(["X", "Y", "Z", "RX", "RY", "RZ"]), st.sampled_from([1, -1])
)  # scalars have no sense of their own
SETS = st.lists(DOFS, min_size=2, max_size=6, unique_by=lambda d: d.key)


def frf_of(dofs, references, seed, lines=5):
    """FRFs of random values that answer to the labels: the value belongs to node and axis, its sign to the sense."""
    rng = np.random.default_rng(seed)
    data = rng.standard_normal((len(dofs), len(references), lines)) + 1j * rng.standard_normal((len(dofs), len(references), lines))
    variance, coherence = rng.uniform(0.1, 1, data.shape), rng.uniform(0.1, 1, data.shape)
    return Frf(data, FrequencyAxis(np.arange(5.0, 5.0 + lines)), dofs, references, variance=variance, coherence=coherence)


def model_of(dofs, seed, n=3, complex_shapes=False, residual=0):
    rng = np.random.default_rng(seed)
    shapes = rng.standard_normal((len(dofs), n)) + (1j * rng.standard_normal((len(dofs), n)) if complex_shapes else 0)
    size = n * (2 + len(dofs) * (2 if complex_shapes else 1))
    root = rng.standard_normal((size, size))
    flags = np.arange(n) >= n - residual
    return ModalModel.from_terms(
        np.sort(rng.uniform(10, 100, n)), rng.uniform(0.001, 0.05, n), shapes, dofs, "unscaled" if complex_shapes else "unit_modal_mass",
        residual=flags, covariance=1e-6 * root @ root.T, band_hz=(5.0, 120.0),
    )  # fmt: skip


def parameters(model):
    """θ = [f, ζ, shapes mode by mode (real parts, then imaginary ones)]."""
    t = model.terms
    parts = [t.frequencies_hz, t.damping_ratios, t.shapes.real.T.ravel()]
    return np.concatenate([*parts, t.shapes.imag.T.ravel()] if np.iscomplexobj(t.shapes) else parts)


# DOFs


@QUICK
@given(DOFS)
def test_a_dof_is_what_it_writes(dof):
    assert Dof.parse(str(dof)) == dof
    assert Dof.parse(str(dof).lower()) == dof
    assert dof.opposite.opposite == dof
    assert dof.opposite != dof
    assert dof.opposite.key == dof.key == dof.unsigned.key
    assert dof.unsigned.sign == 1
    assert Dof.from_uff(dof.node, dof.uff_code) == dof


@QUICK
@given(SETS, st.data())
def test_dofs_are_found_in_either_sense_and_any_order(dofs, data):
    wanted = [d if data.draw(st.booleans()) else d.opposite for d in data.draw(st.permutations(dofs))]
    at, signs = match_dofs(tuple(wanted), tuple(dofs))
    for d, i, sign in zip(wanted, at, signs, strict=True):
        assert dofs[i].key == d.key
        assert (dofs[i] if sign > 0 else dofs[i].opposite) == d
    back, again = match_dofs(tuple(dofs), tuple(wanted))
    assert [back[i] for i in at] == list(range(len(dofs)))  # one is the other's inverse
    assert [signs[k] * again[at[k]] for k in range(len(dofs))] == [1] * len(dofs)
    assert parse_dofs(", ".join(map(str, wanted))) == tuple(wanted)


@QUICK
@given(SETS, SETS)
def test_common_dofs_are_the_same_from_both_sides(first, second):
    there = {(i, j, s) for i, j, s in DofIndex(first).common(second)}
    assert there == {(j, i, s) for i, j, s in DofIndex(second).common(first)}
    assert {first[i].key for i, _, _ in there} == {d.key for d in first} & {d.key for d in second}


# Units

UNITS = (
    "m/s2",
    "mm/s2",
    "g",
    "in/s2",
    "m/s",
    "mm/s",
    "km/h",
    "m",
    "mm",
    "um",
    "mil",
    "N",
    "kN",
    "MN",
    "mN",
    "lbf",
    "kgf",
    "psi",
    "kPa",
    "MPa",
    "deg",
)


@QUICK
@given(st.sampled_from(UNITS), st.integers(0, 99), NUMBERS)
def test_units_convert_there_and_back(first, second, value):
    quantity, factor = parse_unit(first)
    other = [unit for unit in UNITS if parse_unit(unit)[0] == quantity]
    second = other[second % len(other)]
    over = si_factor(first, quantity) / si_factor(second, quantity)
    assert si_factor(first) == factor > 0
    assert value * over * (si_factor(second) / si_factor(first)) == pytest.approx(value, rel=1e-12, abs=1e-300)


@pytest.mark.parametrize("same", [("m/s2", "m/s^2", "m/s²", "m/s**2", "m/sec2"), ("mN", " mN "), ("N m", "N-m", "N.m", "Nm")])
def test_one_unit_in_several_spellings_is_one(same):
    assert len({parse_unit(text) for text in same}) == 1
    assert parse_unit("MN")[1] == 1e9 * parse_unit("mN")[1]


# Alignment of FRFs


@QUICK
@given(SETS, SETS, SEEDS, st.data())
def test_frfs_answer_to_labels_whatever_their_order_and_sense(dofs, references, seed, data):
    frf = frf_of(dofs, references, seed)
    turn = lambda labels: [d if data.draw(st.booleans()) else d.opposite for d in data.draw(st.permutations(labels))]  # noqa: E731
    other = frf.select(turn(dofs), turn(references))
    back = other.select(dofs, references)
    assert np.array_equal(back.data, frf.data)
    assert np.array_equal(back.variance, frf.variance)
    assert np.array_equal(back.coherence, frf.coherence)
    one = (dofs[0].opposite, references[-1])
    assert np.array_equal(other[one].data, frf[one].data)
    assert np.array_equal(frf[one].data, -frf[dofs[0], references[-1]].data)


@QUICK
@given(SETS, SETS, SEEDS, st.integers(1, 5))
def test_columns_apart_are_the_matrix_again(dofs, references, seed, cut):
    frf = frf_of(dofs, references, seed)
    at = 1 + cut % (len(references) - 1) if len(references) > 2 else 1
    left, right = frf.select(None, references[:at]), frf.select(None, references[at:])
    assert np.array_equal(left.beside(right).data, frf.data)
    merged = merge_frfs([right, left]).select(dofs, references)
    assert np.array_equal(merged.data, frf.data)
    assert np.allclose(merged.variance, frf.variance)


@QUICK
@given(SETS, SEEDS, st.sampled_from(["accelerance", "mobility", "receptance"]), st.sampled_from(["mobility", "receptance", "accelerance"]))
def test_quantities_convert_there_and_back(dofs, seed, first, second):
    frf = frf_of(dofs, dofs[:1], seed).to_quantity(first)
    back = frf.to_quantity(second).to_quantity(first)
    assert np.allclose(back.data, frf.data, rtol=1e-12)
    assert np.allclose(back.variance, frf.variance, rtol=1e-12)


# Covariance of selections


@QUICK
@given(SETS, SEEDS, st.booleans(), st.data())
def test_covariance_of_a_selection_is_that_of_its_parameters(dofs, seed, complex_shapes, data):
    model = model_of(dofs, seed, complex_shapes=complex_shapes, residual=0 if complex_shapes else data.draw(st.integers(0, 1)))
    wanted = [d if data.draw(st.booleans()) else d.opposite for d in data.draw(st.permutations(dofs))][
        : data.draw(st.integers(1, len(dofs)))
    ]
    keep = data.draw(st.lists(st.integers(0, model.terms.n - 1), min_size=1, max_size=3, unique=True).map(sorted))
    for select in (lambda m: m[wanted], lambda m: m.select_terms(keep), lambda m: m[wanted].select_terms(keep)):
        chosen = select(model)
        # a selection is linear in θ: its matrix, column by column
        t, size = model.terms, len(model.covariance)
        start, columns = parameters(chosen), []
        n, m = t.n, len(dofs)
        for k in range(size):
            hz, zeta, shapes = t.frequencies_hz.copy(), t.damping_ratios.copy(), t.shapes.copy()
            if k < n:
                hz[k] += 1e-3
            elif k < 2 * n:
                zeta[k - n] += 1e-3
            else:
                part, r, i = (k - 2 * n) // (n * m), (k - 2 * n) % (n * m) // m, (k - 2 * n) % m
                shapes[i, r] += 1e-3 * (1j if part else 1)
            moved = model.with_terms(frequencies_hz=hz, damping_ratios=zeta, shapes=shapes)
            columns.append((parameters(select(moved)) - start) / 1e-3)
        slope = np.round(np.stack(columns, axis=1))
        assert np.allclose(chosen.covariance, slope @ model.covariance @ slope.T, rtol=1e-9, atol=1e-18)


# Add and remove

EFFECTS = ("point_mass@1+Z=mass:0.3", "ground_spring@2+Z=stiffness:2e4", "coupling_damper@1+Z,3+Z=damping:20")


@QUICK
@given(SEEDS, st.lists(st.sampled_from(EFFECTS), min_size=1, max_size=3), st.data())
def test_an_effect_added_and_removed_leaves_the_model(seed, texts, data):
    idle = replace(model_of(parse_dofs("1+Z, 2+Z, 3+Z"), seed), covariance=None)
    hz = np.linspace(5, 120, 7)
    model = Model(idle)
    for text in texts:
        model = model.add(text)
    step = data.draw(st.integers(1, len(texts)))
    without = Model(idle)
    for text in texts[: step - 1] + texts[step:]:
        without = without.add(text)
    assert model.remove(step).effects == without.effects
    assert np.array_equal(model.remove(step).frf(hz).data, without.frf(hz).data)
    for _ in texts:
        model = model.remove(1)
    assert np.array_equal(model.frf(hz).data, Model(idle).frf(hz).data)


# HDF5


@QUICK
@given(SETS, SEEDS, st.booleans(), st.text("abcÄµ 0/\\", max_size=8))
def test_hdf5_gives_back_what_was_written(tmp_path, dofs, seed, holes, name):
    rng = np.random.default_rng(seed)
    frf = replace(frf_of(dofs, dofs[:2], seed), name=name)
    if holes:
        values = frf.data.copy()
        values[0, 0, 1:3] = np.nan
        frf = replace(frf, data=values)
    channels = [Channel(d, "acceleration", "m/s2", name) for d in dofs]
    record = TimeRecord(rng.standard_normal((len(dofs), 9)), float(rng.uniform(1, 1e5)), channels, name=name)
    model = model_of(dofs, seed, complex_shapes=bool(seed % 2))
    geometry = Geometry(tuple(range(1, 4)), rng.standard_normal((3, 3)), ((1, 2, 3),))
    path = tmp_path / "objects.h5"
    write_hdf5(path, {"frf": frf, "record": record, "model": model, "geometry": geometry})
    again = read_hdf5(path)
    for attribute in ("data", "frequencies_hz", "variance", "coherence"):
        assert np.array_equal(getattr(again["frf"], attribute), getattr(frf, attribute), equal_nan=True)
    assert (again["frf"].responses, again["frf"].references, again["frf"].name) == (frf.responses, frf.references, name)
    assert np.array_equal(again["record"].data, record.data)
    assert (again["record"].sampling_hz, again["record"].channels) == (record.sampling_hz, record.channels)
    assert np.array_equal(parameters(again["model"]), parameters(model))
    assert np.array_equal(again["model"].covariance, model.covariance)
    assert np.array_equal(again["geometry"].coordinates, geometry.coordinates)
    assert again["geometry"].lines == geometry.lines
