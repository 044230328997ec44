"""Twelve tasks of a lab engineer, each one line of Python, on the measurement files that come with the repository."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import operando

EXAMPLE = Path(__file__).resolve().parents[1] / "data" / "example"
BAND = (20.0, 70.0)

pytestmark = pytest.mark.skipif(not EXAMPLE.is_dir(), reason="the example data are not here (data/example)")


@pytest.fixture(autouse=True)
def no_figure_stays_open():
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


@pytest.fixture(scope="module")
def hammer():
    return operando.read(f"{EXAMPLE}/idle/*.uff")  # task 1: read a folder


@pytest.fixture(scope="module")
def frf(hammer):
    return operando.estimate_frf(hammer.records, block_seconds=8.0)


@pytest.fixture(scope="module")
def idle(frf):
    return operando.fit_ema(frf, band=BAND, ema="linear")


@pytest.fixture(scope="module")
def running():
    return operando.fit_oma(operando.read(f"{EXAMPLE}/operating/*.uff").records, band=BAND)


@pytest.fixture(scope="module")
def geometry():
    return operando.read(EXAMPLE / "geometry.uff").geometry


def test_1_read_a_folder(hammer):
    assert [Path(r.name).name for r in hammer.records] == ["hammer1.uff", "hammer2.uff", "hammer3.uff"]
    assert hammer.records[1]["9-Z:force"].channels[0].is_force
    assert "3 records" in repr(hammer)


def test_2_plot_an_frf(frf):
    axes = frf["9+Z", "9+Z"].plot()
    assert [a.get_ylabel() for a in axes.figure.axes] == ["Accelerance [(m/s²)/N]", "Phase [°]", "Coherence [–]"]
    assert axes.get_title(loc="left") == "9+Z from 9+Z"
    drawn = axes.lines[0].get_ydata()
    assert np.nanmax(drawn) == pytest.approx(np.abs(frf["9+Z", "9+Z"].data).max())


def test_3_overlay_two(frf, idle):
    axes = idle.frf(np.arange(20, 70, 0.1), "9+Z", "12+Z").plot(frf["9+Z", "12+Z"].band(*BAND).plot())
    assert len(axes.lines) == 2
    assert len(axes.figure.axes[1].lines) == 2  # the phase is overlaid as well
    assert len({line.get_color() for line in axes.lines}) == 2


def test_4_stabilisation_diagram(idle, frf):
    axes = idle.plot_stabilization(frf=frf)
    words = [t.get_text() for t in axes.get_legend().get_texts()]
    assert any(w.startswith("s ") for w in words)
    assert "MMIF, 0 to 1" in words
    assert any("MAC ≥ 0.95" in t.get_text() for t in axes.texts)


def test_5_pick_modes_by_hand(frf, idle):
    by_hand = operando.fit_ema(frf, band=BAND, modes_hz=[27.2, 58.5], automatic=idle)
    assert np.allclose(by_hand.frequencies_hz, [27.24, 58.49], atol=0.05)


def test_6_draw_and_animate_a_shape(idle, geometry, tmp_path):
    axes = idle.plot_shape(1, geometry)
    assert axes.name == "3d"
    assert axes.get_xlabel() == "x [m]"
    assert {t.get_text() for t in axes.texts} >= {str(n) for n in geometry.nodes}
    idle.animate(1, geometry, frames=4).save(tmp_path / "mode.gif", writer="pillow")
    assert (tmp_path / "mode.gif").stat().st_size > 5000


def test_7_mac_of_two_models(idle, running):
    values = operando.mac(idle, running)
    assert values.shape == (idle.n_modes, running.n_modes)
    assert np.max(values, axis=0).min() > 0.9
    assert idle.plot_mac(running).get_title(loc="left") == "Cross-MAC over 13 DOFs"


def test_8_export_to_pandas(frf, idle, hammer):
    pytest.importorskip("pandas")
    table = frf.to_dataframe()
    assert table["9-Z", "12+Z"].iloc[100] == frf.data[8, 2, 100]
    assert table.attrs["unit"] == "(m/s²)/N"
    assert list(idle.to_dataframe()["frequency_hz"]) == list(idle.frequencies_hz)
    assert hammer.records[0].to_dataframe().shape == (hammer.records[0].n_samples, 14)


def test_9_compare_two_models(idle, running):
    compared = operando.compare(idle, running)
    assert [round(m["frequency_percent"], 1) for m in compared.modes] == pytest.approx([0.8, 3.3, 0.0, 1.0], abs=0.3)
    assert all(m["same_shape"] for m in compared.modes)


def test_10_add_an_effect(idle):
    model = operando.Model(idle).add("point_mass@9+Z=mass:0.5")
    assert model.modes().frequencies_hz[0] < idle.frequencies_hz[0]


def test_11_write_an_own_effect(idle):
    from operando.structure.effects import unregister

    @operando.register
    class Inerter(operando.EffectKind):
        kind, plain, places = "inerter", "an inerter between two points", 2
        parameters = (operando.Parameter("inertance", "kg", 1e-3, 1e4, "log", 1.0, "inertance"),)

        def dynamic_stiffness(self, s, values):
            return values["inertance"] * s**2

    try:
        changed = operando.Model(idle).add("inerter@9+Z,12+Z=inertance:0.5").modes()
        assert changed.frequencies_hz[0] != pytest.approx(idle.frequencies_hz[0], rel=1e-6)
    finally:
        unregister("inerter")


def test_12_save_and_load(idle, tmp_path):
    idle.save(tmp_path / "idle.h5")
    again = operando.load(tmp_path / "idle.h5", operando.ModalModel)
    assert np.array_equal(again.shapes, idle.shapes)
    assert again.details.stabilization.tolerances == idle.details.stabilization.tolerances
