"""Scale of operational shapes against analytic truth."""

import numpy as np
import pytest

from operando.data import ModalModel
from operando.errors import DataError
from operando.scaling import METHODS, scale_operational
from structures import Chain, modified


def models(chain, changed, keep=None, rng=None):
    dofs = tuple(f"{i}+Z" for i in range(1, len(chain.hz) + 1))
    keep = range(len(chain.hz)) if keep is None else keep
    idle = ModalModel(chain.hz, chain.zeta, chain.phi, dofs, "unit_modal_mass")
    factor = np.ones(len(keep)) if rng is None else rng.normal(size=len(keep)) + 1j * rng.normal(size=len(keep))
    operating = ModalModel(changed.hz[keep], changed.zeta[keep], changed.phi[:, keep] * factor, dofs)
    return idle, operating


@pytest.mark.parametrize("method", ["auto", *METHODS])
def test_nothing_changed_gives_the_idle_frf(method):
    chain = Chain(6)
    idle, operating = models(chain, chain, rng=np.random.default_rng(1))
    f = np.linspace(5, 150, 300)
    hybrid = scale_operational(idle, operating, method=method)
    # The expansion weighs shapes by an assumed noise: exact only to second order in it.
    tolerance = 1e-6 if hybrid.method.startswith("expansion") else 1e-10
    assert np.max(np.abs(hybrid.frf(f).data - chain.accelerance(f))) < tolerance * np.max(np.abs(chain.accelerance(f)))
    assert all(p.kind == "unchanged" for p in hybrid.pairing.pairs)


@pytest.mark.parametrize("method", ["eq13", "eq15", "eq20"])
def test_spring_is_exact_with_all_modes(method):
    chain = Chain(6)
    changed = modified(chain, spring=(2, 3e5))
    idle, operating = models(chain, changed, rng=np.random.default_rng(2))
    f = np.linspace(5, 150, 300)
    hybrid = scale_operational(idle, operating, threshold=1.0, method=method)
    exact = changed.accelerance(f)
    assert np.linalg.norm(hybrid.frf(f).data - exact) < 1e-9 * np.linalg.norm(exact)


@pytest.mark.parametrize("method", ["auto", *METHODS])
def test_arbitrary_scale_changes_nothing(method):
    rng = np.random.default_rng(3)
    chain = Chain(6)
    changed = modified(chain, spring=(2, 2e5))
    idle, operating = models(chain, changed, keep=[0, 1, 2, 3, 4])
    noisy = np.asarray(operating.shapes) + 0.02 * (rng.normal(size=(6, 5)) + 1j * rng.normal(size=(6, 5)))
    f = np.linspace(5, 150, 200)
    frfs = []
    for factor in (np.ones(5), 10.0 ** rng.uniform(-6, 6, 5) * np.exp(2j * np.pi * rng.uniform(size=5))):
        op = ModalModel(operating.frequencies_hz, operating.damping_ratios, noisy * factor, operating.dofs)
        frfs.append(scale_operational(idle, op, method=method).frf(f).data)
    assert np.max(np.abs(frfs[1] - frfs[0]) / np.abs(frfs[0])) < 1e-9


def test_idle_without_units_is_refused():
    chain = Chain(4)
    idle, operating = models(chain, chain)
    with pytest.raises(DataError, match="not scaled"):
        scale_operational(ModalModel(chain.hz, chain.zeta, chain.phi, idle.dofs), operating)
