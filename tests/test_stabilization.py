"""Classification and automatic selection on made-up diagrams with known physical and spurious poles."""

from __future__ import annotations

import numpy as np
import pytest

from operando.errors import DataError, IdentificationError
from operando.stabilization import HAND_TOLERANCE, STATUS, Tolerances, classify, select_modes

HZ = np.array([5.0, 12.0, 12.1, 20.0, 33.0])  # 12.0 and 12.1 are a close pair
ZETA = np.array([0.01, 0.005, 0.02, 0.008, 0.03])


def diagram(seed=0, n_orders=30, n_spurious=8, m=6, scatter=1e-3, born=(0, 0, 6, 3, 0)):
    rng = np.random.default_rng(seed)
    shapes = np.linalg.qr(rng.standard_normal((m, m)))[0][:, :5]
    orders, hz, zeta, vectors = [], [], [], []
    for k in range(n_orders):
        there = np.array(born) <= k
        f = HZ[there] * (1 + scatter * rng.standard_normal(there.sum()))
        z = ZETA[there] * (1 + 0.03 * rng.standard_normal(there.sum()))
        v = shapes[:, there] + 0.02 * rng.standard_normal((m, there.sum()))
        fs = rng.uniform(2, 40, n_spurious)
        zs = rng.uniform(-0.02, 0.2, n_spurious)
        vs = rng.standard_normal((m, n_spurious)) + 1j * rng.standard_normal((m, n_spurious))
        orders.append(2 * (k + 3))
        hz.append(np.append(f, fs))
        zeta.append(np.append(z, zs))
        vectors.append(np.concatenate([v, vs], axis=1))
    return orders, hz, zeta, vectors, shapes


def test_status_steps_down_with_each_criterion():
    v = np.eye(3)[:, :1]
    orders = [2, 4]
    cases = [
        (10.005, 0.0102, v, "stable"),
        (10.005, 0.0102, np.eye(3)[:, 1:2], "frequency_damping"),
        (10.005, 0.02, v, "frequency"),
        (11.0, 0.01, v, "unstable"),
        (10.0, -0.01, v, "invalid"),
        (10.0, 0.5, v, "invalid"),
        (np.nan, 0.01, v, "invalid"),
    ]
    for f, z, vec, expected in cases:
        table = classify(orders, [[10.0], [f]], [[0.01], [z]], [v, vec])
        assert STATUS[table.status[1]] == expected
        assert STATUS[table.status[0]] == "unstable"  # nothing below the first order


@pytest.mark.parametrize("seed", range(20))
def test_all_modes_no_spurious_close_pair_kept_apart(seed):
    orders, hz, zeta, vectors, shapes = diagram(seed)
    found = select_modes(classify(orders, hz, zeta, vectors), band=(2, 40))
    assert found.selected_hz.size == 5
    np.testing.assert_allclose(found.selected_hz, HZ, rtol=2e-3)
    np.testing.assert_allclose(found.selected_damping, ZETA, rtol=0.1)
    mac = np.abs(np.sum(found.selected_vectors.conj() * shapes, axis=0)) ** 2
    assert mac.min() > 0.98
    for members in found.selected_members:
        assert np.unique(found.table.order[members]).size == members.size


def test_reasons_carry_code_and_numbers():
    orders, hz, zeta, vectors, _ = diagram(born=(0, 0, 6, 25, 0), n_spurious=0)
    zeta = [np.where(np.abs(f - 33) < 1, 0.4, z) for f, z in zip(hz, zeta, strict=True)]
    found = select_modes(classify(orders, hz, zeta, vectors), band=(6, 40))
    assert found.selected_hz.size == 2
    codes = {round(r.frequency_hz): r.code for r in found.rejected}
    assert codes == {5: "outside_band", 20: "small_cluster", 33: "too_damped"}
    assert "5 of 30" in next(r.reason for r in found.rejected if r.code == "small_cluster")


def test_choice_by_hand_is_honoured():
    orders, hz, zeta, vectors, _ = diagram(born=(0, 0, 6, 25, 0))
    table = classify(orders, hz, zeta, vectors)
    assert select_modes(table).selected_hz.size == 4
    found = select_modes(table, select_hz=[20.03, 12.1], reject_hz=[33.1, 7.0])
    np.testing.assert_allclose(found.selected_hz, [5, 12, 12.1, 20], rtol=2e-3)
    by_hand = [r for r in found.rejected if r.code == "by_hand"]
    assert [round(r.frequency_hz) for r in by_hand] == [7, 33]
    assert "no mode was selected" in by_hand[0].reason
    with pytest.raises(IdentificationError, match="nearest is"):
        select_modes(table, select_hz=[90.0])


def test_a_frequency_by_hand_means_a_mode_up_to_a_relative_distance():
    """HAND_TOLERANCE: what is nearer is meant, what is farther off means none."""
    orders, hz, zeta, vectors, _ = diagram(born=(0, 0, 6, 25, 0))
    table = classify(orders, hz, zeta, vectors)
    near, far = (33 * (1 + part * HAND_TOLERANCE) for part in (0.8, 1.3))
    assert not np.any(np.abs(select_modes(table, reject_hz=[near]).selected_hz - 33) < 0.1)
    assert np.any(np.abs(select_modes(table, reject_hz=[far]).selected_hz - 33) < 0.1)


def test_a_frequency_with_all_its_digits_means_that_chain_however_short():
    orders, shape = list(range(2, 32)), np.array([[1.0, 0.3], [0.5, -1.0]])
    twice = [10 <= n < 14 for n in orders]
    hz = [[20.0, 20.1] if both else [20.0] for both in twice]
    zeta = [[0.01, 0.02] if both else [0.01] for both in twice]
    table = classify(orders, hz, zeta, [shape if both else shape[:, :1] for both in twice])
    assert select_modes(table).selected_hz.tolist() == [20.0]
    assert select_modes(table, select_hz=[20.09]).selected_hz.tolist() == [20.0]
    assert select_modes(table, select_hz=[20.1]).selected_hz.tolist() == [20.0, 20.1]


def test_a_split_pole_is_a_duplicate_of_its_mode():
    orders, hz, zeta, vectors, shapes = diagram(n_spurious=0)
    for k in range(12, 30):
        hz[k] = np.append(hz[k], 33.3)
        zeta[k] = np.append(zeta[k], 0.05)
        vectors[k] = np.column_stack([vectors[k], shapes[:, 4]])
    found = select_modes(classify(orders, hz, zeta, vectors))
    assert found.selected_hz.size == 5
    assert [r.code for r in found.rejected] == ["duplicate"]


def test_wrong_input_is_refused():
    with pytest.raises(DataError, match="increase"):
        classify([4, 2], [[1.0], [1.0]], [[0.1], [0.1]], [np.ones((2, 1))] * 2)
    with pytest.raises(DataError, match="belong together"):
        classify([2], [[1.0, 2.0]], [[0.1]], [np.ones((2, 1))])
    with pytest.raises(DataError):
        Tolerances(mac=2.0)
