"""Results with exact models of the chain at rest and in operation, as a finished run would hold them."""

from __future__ import annotations

import numpy as np

from measurements import idle_chain, running_chain


def dofs():
    from operando.dof import Dof

    return tuple(Dof(i + 1, "Z") for i in range(4))


def idle_model():
    from operando.data import ModalModel

    chain = idle_chain()
    n = 4
    std = np.concatenate([1e-5 * chain.hz, 2e-3 * chain.zeta, 1e-3 * np.abs(chain.phi).T.ravel() + 1e-5])
    return ModalModel.from_terms(
        chain.hz,
        chain.zeta,
        chain.phi,
        dofs(),
        "unit_modal_mass",
        residual=np.zeros(n, bool),
        covariance=np.diag(std**2),
        band_hz=(10.0, 90.0),
    )


def operating_model():
    from operando.data import ModalModel

    chain = running_chain()
    factors = np.array([1.0, -2j, 0.3 + 0.4j, 5.0])
    shapes = chain.phi * factors
    part = 1e-3 * np.abs(shapes).T.ravel() + 1e-5
    std = np.concatenate([1e-4 * chain.hz, 2e-2 * chain.zeta, part, part])
    return ModalModel(chain.hz, chain.zeta, shapes, dofs(), "unscaled", covariance=np.diag(std**2), band_hz=(10.0, 90.0))


def measured(chain, name="check", quantity="accelerance", references=(0,), noise=1e-3, step=0.25):
    """FRFs of the chain with noise of the variance stated."""
    from operando.data import FrequencyAxis, Frf

    lines = np.arange(5.0, 100.0 + step / 2, step)
    exact = chain.accelerance(lines, ref=references)
    sigma = noise * np.sqrt(np.mean(np.abs(exact) ** 2))
    rng = np.random.default_rng(7)
    data = exact + sigma / np.sqrt(2) * (rng.normal(size=exact.shape) + 1j * rng.normal(size=exact.shape))
    columns = tuple(dofs()[i] for i in references)
    variance = np.full(exact.shape, sigma**2)
    frf = Frf(data, FrequencyAxis(lines), dofs(), columns, variance=variance, averages=50.0, name=name)
    return frf.to_quantity(quantity)


def results():
    from operando.data import Finding, Geometry
    from operando.results import CheckRun, Results
    from operando.scaling import scale_operational

    idle, operating = idle_model(), operating_model()
    return Results(
        "chain",
        settings={"band": [10.0, 90.0], "threshold": 0.7},
        findings=[Finding("few_averages", "only 4 averages", "warning", file="run1.uff", band_hz=(1.0, 2.0))],
        geometry=Geometry((1, 2, 3, 4), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]), ((1, 2, 3, 4),)),
        idle_frf=measured(idle_chain(), "idle", references=(0, 2)),
        idle=idle,
        operating=operating,
        hybrid=scale_operational(idle, operating),
        check=[CheckRun("run1", "2 N rms", measured(running_chain()))],
    )
