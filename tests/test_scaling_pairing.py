"""Pairing, classes, conflicts, condensed mass and choice of DOFs."""

import numpy as np
import pytest

from operando.data import ModalModel
from operando.errors import ConfigError, DataError, IdentificationError
from operando.scaling import choose_dofs, condensed_basis, condensed_mass, pair_modes, scale_operational
from operando.scaling.condensed import best_addition
from structures import Chain, modified


def labels(n):
    return tuple(f"{i}+Z" for i in range(1, n + 1))


def test_order_does_not_matter():
    chain = Chain(6)
    order = np.array([3, 0, 5, 1, 4, 2])
    pairing = pair_modes(chain.phi, chain.hz, chain.phi[:, order] * 1j, chain.hz[order])
    assert pairing.partners.tolist() == order.tolist()
    assert pairing.mac[order, np.arange(6)] == pytest.approx(1)


def test_one_to_one_with_conflict():
    rng = np.random.default_rng(0)
    a = np.linalg.qr(rng.normal(size=(8, 3)))[0]
    copy = a[:, 0] + 0.05 * rng.normal(size=8)
    operating = np.column_stack([a[:, 0], copy, a[:, 2]])
    pairing = pair_modes(a, [10.0, 20, 30], operating, [10.1, 10.4, 30.1])
    assert sorted(p.idle for p in pairing.pairs if p.idle is not None) in ([0, 1, 2], [0, 2])
    assert pairing.pairs[0].idle == 0
    assert pairing.pairs[1].kind in ("changed", "unpaired")
    assert len(pairing.conflicts) == 1
    assert "10.40 Hz" in pairing.conflicts[0]
    assert pairing.pairs[1].note == pairing.conflicts[0]


def test_frequency_breaks_ties_between_like_shapes():
    v = np.array([[1.0, 1.0], [1.0, 1.0001], [0.5, 0.5]])
    pairing = pair_modes(v, [10.0, 40.0], v[:, ::-1], [39.0, 10.3])
    assert pairing.partners.tolist() == [1, 0]


def test_beyond_idle_band_is_looked_at_and_classed():
    chain = Chain(6)
    in_band = np.array([True] * 4 + [False] * 2)
    pairing = pair_modes(chain.phi, chain.hz, chain.phi[:, [0, 1, 4]], chain.hz[[0, 1, 4]] * 0.97, in_band=in_band)
    assert [p.kind for p in pairing.pairs] == ["unchanged", "unchanged", "beyond_idle_band"]
    assert pairing.idle_without_partner == [2, 3, 5]


def test_unpaired_when_operational_modes_are_more():
    chain = Chain(5)
    pairing = pair_modes(chain.phi[:, :3], chain.hz[:3], chain.phi, chain.hz)
    assert [p.kind for p in pairing.pairs] == ["unchanged"] * 3 + ["unpaired"] * 2
    assert pairing.pairs[4].idle is None


@pytest.mark.parametrize("threshold", [0, -0.1, 1.5])
def test_wrong_threshold(threshold):
    with pytest.raises(ConfigError, match="threshold"):
        pair_modes(np.eye(2), [1, 2], np.eye(2), [1, 2], threshold)


def test_condensed_mass_is_the_mass_for_all_modes():
    chain = Chain(6)
    assert np.allclose(condensed_mass(chain.phi), chain.M, rtol=1e-9, atol=1e-12)


def test_condensed_mass_gives_unit_modal_masses_or_refuses():
    chain = Chain(8)
    few = chain.phi[:, :3]
    assert few.T @ condensed_mass(few) @ few == pytest.approx(np.eye(3))
    with pytest.raises(IdentificationError, match="does not give unit modal masses"):
        condensed_mass(chain.phi[:4])
    with pytest.raises(IdentificationError, match="does not give unit modal masses"):
        condensed_mass(chain.phi[:, [0, 1, 1]])


def test_basis_never_holds_more_modes_than_dofs():
    chain = Chain(8)
    basis = condensed_basis(chain.phi[:5], chain.hz, np.ones(8, bool))
    assert basis.modes.size <= 5
    assert len(basis.left_out) == 8 - basis.modes.size
    used = chain.phi[:5][:, basis.modes]
    assert basis.kappa == pytest.approx(np.linalg.cond(used))


def test_pivoted_choice_finds_the_independent_dofs():
    rng = np.random.default_rng(2)
    good = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    # Rows 0 to 2 are copies of one row, rows 3 to 5 independent and larger.
    shapes = np.vstack([good[[0, 0, 0]] * 0.1, good])
    assert sorted(choose_dofs(shapes)) == [3, 4, 5]


def test_large_kappa_names_modes_and_dofs():
    chain = Chain(6)
    phi = chain.phi[:, :3].copy()
    phi[:, 2] = phi[:, 1] + 1e-4 * chain.phi[:, 4]
    idle = ModalModel(chain.hz[:3], chain.zeta[:3], phi, labels(6), "unit_modal_mass")
    operating = ModalModel(chain.hz[:2], chain.zeta[:2], chain.phi[:, :2] + 0j, labels(6))
    hybrid = scale_operational(idle, operating)
    finding = next(f for f in hybrid.findings if f.kind == "ill_conditioned")
    assert hybrid.kappa > 1000
    assert finding.dof
    assert f"{chain.hz[1]:.2f}" in finding.action


def test_advice_names_the_dof_that_lowers_kappa_most():
    """Sensors at two places cannot tell three shapes apart; of the places known from rest only, one is best."""
    chain = Chain(6)
    idle = ModalModel(chain.hz[:3], chain.zeta[:3], chain.phi[:, :3], labels(6), "unit_modal_mass")
    rows = [0, 1, 2]
    operating = ModalModel(chain.hz[:3], chain.zeta[:3], chain.phi[rows, :3] + 0j, labels(3))
    reached = {row: np.linalg.cond(chain.phi[[*rows, row], :3]) for row in (3, 4, 5)}
    best = min(reached, key=reached.__getitem__)
    assert best_addition(chain.phi[:, :3], rows, [0, 1, 2]) == (best, pytest.approx(reached[best]))
    assert best_addition(chain.phi[:, :3], range(6), [0, 1, 2]) is None
    squeezed = chain.phi[:, :3].copy()
    squeezed[rows, 2] = squeezed[rows, 1] * (1 + 1e-3 * np.arange(3))
    idle = ModalModel(chain.hz[:3], chain.zeta[:3], squeezed, labels(6), "unit_modal_mass")
    finding = next(f for f in scale_operational(idle, operating).findings if f.kind == "ill_conditioned")
    assert f"measure {idle.dofs[best_addition(squeezed, rows, [0, 1, 2])[0]]} in operation as well" in finding.action


def test_dof_order_sense_and_extra_dofs():
    chain = Chain(6)
    changed = modified(chain, spring=(2, 3e5))
    idle = ModalModel(chain.hz, chain.zeta, chain.phi, labels(6), "unit_modal_mass")
    order = [5, 2, 0, 4, 1, 3]
    sign = np.array([1, -1, 1, 1, -1, 1])
    dofs = tuple(f"{i + 1}{'+' if s > 0 else '-'}Z" for i, s in zip(order, sign, strict=True))
    shuffled = ModalModel(changed.hz, changed.zeta, changed.phi[order] * sign[:, None] * 2j, dofs)
    plain = ModalModel(changed.hz, changed.zeta, changed.phi + 0j, labels(6))
    f = np.linspace(5, 150, 100)
    one, other = scale_operational(idle, plain), scale_operational(idle, shuffled)
    assert other.modal.dofs == idle.dofs
    assert np.allclose(one.frf(f).data, other.frf(f).data, rtol=1e-9)
    extra = ModalModel(changed.hz, changed.zeta, np.vstack([changed.phi[:5], changed.phi[:1]]) + 0j, (*labels(5), "99+X"))
    hybrid = scale_operational(idle, extra)
    assert len(hybrid.modal.dofs) == 5
    told = [x.message for x in hybrid.findings if x.kind == "dof_not_common"]
    assert any("6+Z" in t for t in told)
    assert any("99+X" in t for t in told)
    with pytest.raises(DataError, match="no DOF in common"):
        scale_operational(idle, ModalModel(changed.hz, changed.zeta, changed.phi + 0j, tuple(f"{i}+X" for i in range(6))))
