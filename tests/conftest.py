"""Fixtures that several test files share."""

from __future__ import annotations

import os
import shutil
import subprocess

import pytest

from operando import threads
from operando.structure.effects import EffectKind, Parameter, catalogue, register, unregister

WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if WORKERS > 1:  # the processors are in use already: a fit shared between two processes takes a third more of them
    threads.limit(threads.cores() // WORKERS)


@pytest.fixture
def inerter():
    """Name of a kind of the user's own that says its dynamic stiffness alone."""

    class Inerter(EffectKind):
        kind = "inerter_for_test"
        plain = "an inerter between two points"
        places = 2
        parameters = (Parameter("inertance", "kg", 1e-3, 1e4, "log", 1.0),)

        def dynamic_stiffness(self, s, values):
            return values["inertance"] * s**2

    register(Inerter)
    yield Inerter.kind
    unregister(Inerter.kind)


@pytest.fixture
def own_kinds_gone():
    """Takes kinds of effects that a test registers out of the catalogue again."""
    before = set(catalogue())
    yield
    for name in set(catalogue()) - before:
        unregister(name)


@pytest.fixture(scope="session")
def chain_results(tmp_path_factory):
    """A small test with all three states, run once: the folder of its files and, inside, ``results``. Copy it to change it."""
    import measurements
    from operando.pipeline import run

    folder = tmp_path_factory.mktemp("chain")
    path = measurements.write_test(folder)
    path.write_text(path.read_text(encoding="utf-8") + "\n# kept as it is\n", encoding="utf-8")
    run(path, folder / "results")
    return folder


@pytest.fixture
def chain_test(chain_results, tmp_path):
    """A copy of that test to change: its folder."""
    from operando.pipeline.folder import results_folder

    folder = tmp_path / "chain"
    shutil.copytree(chain_results, folder)
    with results_folder(folder / "results", "test") as results:
        results.came_from(folder / "test.toml")
    return folder


@pytest.fixture(scope="session")
def axe(tmp_path_factory):
    """The script of axe-core, from the npm registry."""
    if shutil.which("npm") is None:
        pytest.skip("no npm to fetch axe-core with")
    folder = tmp_path_factory.mktemp("axe")
    order = ["npm", "install", "--prefix", str(folder), "--no-audit", "--no-fund", "--ignore-scripts", "axe-core@4"]
    try:
        subprocess.run(order, check=True, timeout=120, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except (subprocess.SubprocessError, OSError):
        pytest.skip("the npm registry does not give axe-core")
    return (folder / "node_modules" / "axe-core" / "axe.min.js").read_text(encoding="utf-8")
