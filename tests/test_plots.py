"""Figures: Axes in and out, what is drawn where, with which units; curves in the figure are the numbers of the objects."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.collections import CircleCollection, PathCollection
from matplotlib.figure import Figure

from operando import plots
from operando.data import Channel, Finding, Frf, Geometry, ModalModel, TimeRecord
from operando.dof import Dof
from operando.ema import cmif, mmif
from operando.errors import DataError, ObjectError
from operando.indicators import frf_correlation
from operando.plots.fits import fit_circle
from operando.plots.mesh import Mesh
from operando.plots.shapes import draw_shape, draw_small, real_shape
from operando.plots.style import log_axis, new_axes, number, thin
from operando.stabilization import classify, select_modes, stability_letters
from structures import Chain

LINES = np.linspace(5.0, 90.0, 900)


@pytest.fixture(autouse=True)
def no_figure_stays_open():
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


@pytest.fixture(scope="module")
def model():
    chain = Chain(n=4, mass=2.0, stiffness=1.2e5, zeta=0.01, seed=3)
    dofs = tuple(Dof(k + 1, "Z") for k in range(4))
    zeta = np.full(4, 0.01)
    return ModalModel(chain.hz, zeta, chain.phi, dofs, "unit_modal_mass", covariance=np.eye(24) * 1e-10, band_hz=(10.0, 80.0))


@pytest.fixture(scope="module")
def frf(model):
    made = model.frf(LINES, references="1+Z, 3+Z")
    return Frf(
        made.data, LINES, made.responses, made.references, variance=np.abs(made.data) ** 2 / 1e4, coherence=np.full(made.data.shape, 0.9)
    )


@pytest.fixture(scope="module")
def chain_geometry():
    return Geometry((1, 2, 3, 4), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]), ((1, 2, 3, 4),))


def words(axes):
    return [t.get_text() for t in axes.get_legend().get_texts()]


def test_importing_the_figures_loads_no_matplotlib():
    code = "import sys, operando.plots; assert not {'matplotlib', 'scipy.signal', 'pandas'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


# FRFs.


def test_frf_is_drawn_with_its_numbers_and_units(frf):
    top = plots.plot_frf(frf["2+Z", "1+Z"])
    magnitude, phase, coherence = top.figure.axes
    assert magnitude is top
    assert np.allclose(top.lines[0].get_ydata(), np.abs(frf.data[1, 0]))
    shown = phase.lines[0].get_ydata()
    expected = np.degrees(np.angle(frf.data[1, 0]))
    assert np.allclose(shown[np.isfinite(shown)], expected[np.isfinite(shown)])
    assert np.allclose(coherence.lines[0].get_ydata(), 0.9)
    assert top.get_yscale() == "log"


def test_large_matrices_say_how_much_is_drawn(model):
    many = model.frf(LINES)
    assert plots.plot_frf(many).get_title(loc="left").startswith("1 of 16 pairs")
    assert len(plots.plot_frf(many, responses="*", references="1+Z").lines) == 4


def test_the_title_of_an_overlay_names_the_pair_of_each_curve(frf):
    a, b = frf["2+Z", "1+Z"], frf["1+Z", "1+Z"]
    both = "2+Z from 1+Z; 1+Z from 1+Z"
    assert plots.plot_frf([a, b]).get_title(loc="left") == both
    assert plots.plot_frf([a, a]).get_title(loc="left") == "2+Z from 1+Z"
    for labels in (None, ["second"]):
        top = plots.plot_frf(a)
        assert plots.plot_frf(b, top, labels=labels).get_title(loc="left") == both
    top = plots.plot_ofrf(a)
    assert plots.plot_ofrf(b, axes=top).get_title(loc="left") == both
    for title in ("Pump, 900 rpm", "Pump from above"):
        top = plots.plot_frf(a)
        top.set_title(title, loc="left")
        assert plots.plot_frf(b, top, labels=["second"]).get_title(loc="left") == title
        assert plots.plot_ofrf(b, axes=top).get_title(loc="left") == title


def test_own_axes_get_the_magnitude_alone(frf):
    own = new_axes()
    assert plots.plot_frf(frf["1+Z", "1+Z"], own) is own
    assert len(own.figure.axes) == 1


def test_difference_and_noise(frf, model):
    pair = frf["1+Z", "1+Z"]
    made = model.frf(LINES, "1+Z", "1+Z")
    top = plots.plot_frf([pair, made], labels=("measured", "synthesised"), noise=True, difference=True, band=(10, 80))
    assert words(top) == ["noise level (1 σ)", "difference", "measured", "synthesised"]
    with pytest.raises(DataError, match="same pairs and lines"):
        plots.plot_frf([pair, made.decimate(2)], difference=True)
    with pytest.raises(DataError, match="1 labels for 2"):
        plots.plot_frf([pair, made], labels=["one"])
    with pytest.raises(DataError, match="no part"):
        plots.plot_frf(pair, parts=("magnitude", "fase"))


def test_unknown_units_are_said(frf):
    assert plots.plot_frf(replace(frf, si=False)["1+Z", "1+Z"]).get_ylabel() == "Accelerance [units of the file]"


def test_ofrf_has_its_band_in_magnitude_and_phase(model):
    ofrf = model.frf(LINES, "2+Z", "1+Z")
    top = plots.plot_ofrf(ofrf, idle=model.frf(LINES), response="2+Z", reference="1+Z")
    magnitude, phase = top.figure.axes
    assert words(top) == ["idle model", "95 % band", "operational FRF"]
    half = 1.96 * np.sqrt(ofrf.variance[0, 0] / 2)
    corners = magnitude.collections[0].get_paths()[0].vertices[:, 1]
    assert corners.max() == pytest.approx((np.abs(ofrf.data[0, 0]) + half).max(), rel=1e-6)
    assert len(phase.collections) == 1
    with pytest.raises(DataError, match="no FRF"):
        plots.plot_ofrf(None)


# Identification.


def test_symbols_of_the_stabilisation_diagram(model):
    one = np.ones((2, 1))
    other = np.array([[1.0], [-1.0]])
    table = classify(
        [2, 4, 6, 8, 10], [[10.0]] * 5, [[0.01], [0.01], [0.02], [0.02], [-0.1]], [one, one, one, other, other]
    )  # all, vector alone, damping alone, not physical
    assert list(stability_letters(table)) == ["o", "s", "v", "d", ""]
    axes = plots.plot_stabilization(select_modes(table, min_size=2), frf=None, harmonics_hz=[9.9])
    axes.set_ylim(9.0, 12.2)
    assert all(float(order).is_integer() for order in axes.get_yticks()), "there are no halves of a pole"
    behind = replace(select_modes(table, min_size=2), indicator_hz=LINES, indicator=np.ones((1, LINES.size)))
    for si, unit in ((True, "(m/s²)²/Hz"), (False, "units of the file squared per Hz")):
        kept = replace(model, si=si, details=SimpleNamespace(stabilization=behind, harmonics_hz=()))
        labels = [a.get_ylabel() for a in plots.plot_stabilization_of(kept).figure.axes]
        assert f"First singular values [{unit}]" in labels
    told = words(axes)
    assert {"o  new pole", "s  all stable", "v  frequency and vector", "d  frequency and damping", "not physical"} <= set(told)
    assert any("Δf ≤ 1 %, Δζ ≤ 10 %, MAC ≥ 0.95" in t.get_text() for t in axes.texts)
    with pytest.raises(ObjectError, match=r"details\.stabilization"):
        plots.plot_stabilization(table)


def test_mode_indicators(frf, model):
    dips = mmif(frf.data)[0]
    for hz in model.frequencies_hz:
        near = np.abs(LINES - hz) < 1.0
        assert dips[near].min() < 0.1
        assert np.argmax(cmif(frf.data)[0][near]) == pytest.approx(np.argmin(dips[near]), abs=3)
    mobility = frf.to_quantity("mobility")
    assert np.allclose(mmif(mobility.data, "mobility"), mmif(frf.data), atol=1e-6)
    assert np.array_equal(mmif(np.zeros((2, 2, 3))), np.ones((2, 3)))


def test_mmif_is_the_least_in_phase_part_of_any_force():
    """Against its definition: the least of fᵀAf/fᵀ(A+B)f over real forces f, by a scan."""
    rng = np.random.default_rng(4)
    h = rng.normal(size=(3, 2, 1)) + 1j * rng.normal(size=(3, 2, 1))
    a, b = (p[:, :, 0].T @ p[:, :, 0] for p in (h.real, h.imag))
    angle = np.linspace(0, np.pi, 20001)
    f = np.array([np.cos(angle), np.sin(angle)])
    ratio = np.einsum("ik,ij,jk->k", f, a, f) / np.einsum("ik,ij,jk->k", f, a + b, f)
    assert mmif(h)[:, 0] == pytest.approx([ratio.min(), ratio.max()], abs=1e-6)


def test_circle_and_nyquist(frf, model):
    turn = np.exp(1j * np.linspace(0.3, 4, 9))
    centre, radius = fit_circle(3 - 2j + 5e-3 * turn)
    assert (centre, radius) == (pytest.approx(3 - 2j), pytest.approx(5e-3))
    axes = plots.plot_nyquist(frf, model, mode=1)
    assert words(axes) == ["measured lines", "synthesised", "circle fitted"]
    assert axes.get_aspect() == 1.0
    with pytest.raises(DataError, match="no mode 7"):
        plots.plot_nyquist(frf, model, mode=7)
    with pytest.raises(DataError, match="give a model"):
        plots.plot_nyquist(frf, mode=0)


def test_synthesis_correlation_is_by_pair(frf, model):
    assert np.allclose(frf_correlation(frf, frf), 1)
    shifted = model.with_terms(frequencies_hz=model.frequencies_hz * 1.02)
    axes = plots.plot_synthesis_correlation(frf, shifted)
    values = frf_correlation(frf.band(10, 80), shifted.frf(frf.band(10, 80).frequencies_hz, references="1+Z, 3+Z"))
    assert sorted(p.get_height() for p in axes.patches) == pytest.approx(sorted(100 * values.ravel()))
    assert values.max() < 0.9


# Models.


def test_mac_and_participation_write_their_values(model):
    axes = plots.plot_mac(model, model["4-Z, 2+Z, 1+Z"])
    assert axes.get_title(loc="left") == "Cross-MAC over 3 DOFs"
    assert [t.get_text() for t in axes.texts].count("1") == 4
    share = plots.plot_participation(model, dofs="1+Z")
    peak = np.abs(model.shapes).max(axis=0)
    assert [t.get_text() for t in share.texts] == [f"{100 * abs(v) / p:.0f}" for v, p in zip(model.shapes[0], peak, strict=True)]
    with pytest.raises(ObjectError, match=r"hybrid model its \.modal"):
        plots.plot_participation("model")


@pytest.mark.parametrize("size", [(150, 90, 10), (1, 1, 1), (0.2, 0.2, 3)])
def test_words_at_the_axes_of_a_geometry_are_not_cut(size):
    corners = np.array(size) * np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)], float)
    axes = plots.plot_geometry(Geometry(tuple(range(8)), corners))
    figure = axes.get_figure()
    figure.canvas.draw()
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        box = axis.get_tightbbox(figure.canvas.get_renderer())
        assert figure.bbox.contains(box.x0, box.y0)
        assert figure.bbox.contains(box.x1, box.y1)


def test_shapes_stand_where_the_nodes_move(model, chain_geometry):
    axes = plots.plot_shape(model, -1, chain_geometry)
    assert axes.get_title() == f"Mode 3: {model.frequencies_hz[3]:.2f} Hz, ζ 1.00 %"
    assert [axes.get_xlabel(), axes.get_ylabel(), axes.get_zlabel()] == ["x [m]", "y [m]", "z [m]"]
    assert [t.get_text() for t in axes.texts] == ["1", "2", "3", "4"]
    mesh = Mesh(chain_geometry, model.dofs)
    drawn = draw_shape(new_axes(4, 4, "3d"), mesh, real_shape(model.shapes[:, 3]))
    moved, signed = drawn.placed(real_shape(model.shapes[:, 3]))
    assert np.abs(moved[:, 2]).max() == pytest.approx(0.13 * 3.0)
    assert np.allclose(np.abs(signed), np.abs(real_shape(model.shapes[:, 3])))
    back = drawn.move(-real_shape(model.shapes[:, 3]))
    assert np.allclose(drawn.parts["nodes"]._offsets3d[2], -moved[:, 2])
    assert back
    with pytest.raises(DataError, match="no mode 4"):
        plots.plot_shape(model, 4, chain_geometry)
    with pytest.raises(ObjectError, match="flat axes"):
        plots.plot_shape(model, 0, chain_geometry, new_axes())
    with pytest.raises(DataError, match="two measured nodes"):
        plots.plot_shape(model, 0, Geometry((9,), np.zeros((1, 3))))
    with pytest.raises(DataError, match="moves on a geometry"):
        plots.animate_shape(model, 0)


def test_small_shapes_are_seen_from_where_large_ones_are(model, chain_geometry):
    """The picture without axes is that of mplot3d but for its scale, and fills its box."""
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    mesh, shape = Mesh(chain_geometry, model.dofs), real_shape(model.shapes[:, 3])
    large = new_axes(4, 4, "3d")
    moved = draw_shape(large, mesh, shape).placed(shape)[0]
    figure = Figure(figsize=(5, 3))
    draw_small(figure, (1.0, 0.5, 3.0, 2.0), mesh, shape)
    small = np.asarray(figure.findobj(CircleCollection)[0].get_offsets())
    seen = np.column_stack(proj_transform(*moved.T, large.get_proj()))
    seen = seen[np.argsort(-seen[:, 2], kind="stable"), :2]  # drawn from the far to the near
    scale = np.ptp(small[:, 0]) / np.ptp(seen[:, 0])
    assert np.allclose(small - small[0], scale * (seen - seen[0]), atol=1e-9)
    corners = np.vstack([p.vertices for c in figure.findobj(PathCollection) for p in c.get_paths()])
    assert np.max(np.ptp(corners, axis=0) / (3.0, 2.0)) == pytest.approx(0.96)
    assert (corners.min(axis=0) + corners.max(axis=0)) / 2 == pytest.approx([2.5, 1.5])


def test_complex_shapes_are_turned_to_the_real_axis():
    assert np.allclose(np.abs(real_shape(np.array([1.0, -0.5]) * np.exp(0.7j))), [1.0, 0.5])
    assert plots.plot_complexity(ModalModel([1.0], [0.01], np.array([[1.0], [1j]]), "1+Z, 2+Z")).patches[0].get_height() == pytest.approx(0)


def test_complexity_of_real_shapes_is_not_drawn():
    real = ModalModel([1.0], [0.01], np.array([[1.0], [-1.0]]), "1+Z, 2+Z")
    turning = ModalModel([1.0], [0.01], np.array([[1.0], [1j]]), "1+Z, 2+Z")
    with pytest.raises(DataError, match="the shapes are real by construction"):
        real.plot_complexity()
    for draw in (turning.plot_complexity, turning.plot_participation):
        with pytest.raises(ObjectError, match="drawn on matplotlib Axes, not int"):
            draw(0)
    pytest.importorskip("pandas")
    assert "modal_phase_collinearity" not in real.to_dataframe()
    assert turning.to_dataframe()["modal_phase_collinearity"].tolist() == [0.0]


# Records.


def hammer_record():
    rng = np.random.default_rng(1)
    force = 0.01 * rng.normal(size=8000)
    for start, level in ((1000, 100.0), (3000, 80.0), (5000, 10.0), (7000, 90.0)):
        force[start : start + 5] += level * np.array([0.2, 0.8, 1.0, 0.7, 0.1])
    channels = (Channel(Dof(1, "Z"), "force", "N"), Channel(Dof(2, "Z"), "acceleration", "m/s2"))
    finding = Finding("overload", "too much", dof="2+Z", time_s=(2.0, 3.0))
    return TimeRecord(np.array([force, rng.normal(size=8000)]), 1000.0, channels, findings=(finding,))


def test_hits_are_numbered_and_rejected_ones_say_why():
    axes = plots.plot_hits(hammer_record())
    told = words(axes)
    assert [w.split()[0] for w in told] == ["0", "1", "2", "3"]
    assert "not used: weak hit" in told[2]
    assert axes.get_title(loc="left") == "1+Z: 4 hits, 3 used"
    spectra = plots.plot_force_spectra(hammer_record())
    first = spectra.lines[0]
    assert first.get_ydata()[0] == pytest.approx(2.8 * 100 / 1000, rel=0.02)  # at 0 Hz the impulse, N·s
    with pytest.raises(DataError, match="no hits"):
        plots.plot_hits(hammer_record().select([1]))
    with pytest.raises(DataError, match="no force"):
        plots.plot_force_spectra(hammer_record().select([1]))


def test_records_stand_below_one_another_and_findings_are_marked():
    axes = plots.plot_record(hammer_record())
    assert [a.get_ylabel() for a in axes.figure.axes] == ["1+Z\n[N]", "2+Z\n[m/s²]"]
    assert [t.get_text() for t in axes.figure.axes[1].texts] == ["overload"]
    with pytest.raises(DataError, match="do not fit the same axes"):
        plots.plot_record(hammer_record(), new_axes())
    assert plots.plot_record(hammer_record(), new_axes(), channels="2+Z").get_ylabel() == "Acceleration [m/s²]"


def test_densities_hold_the_mean_square():
    record = hammer_record()
    axes = plots.plot_psd(record, channels="2+Z", block_seconds=1.0)
    f, y = axes.lines[0].get_data()
    assert np.sum(y) * (f[1] - f[0]) == pytest.approx(np.var(record.data[1]), rel=0.1)
    assert axes.get_ylabel() == "Acceleration [(m/s²)²/Hz]"


# Style.


def test_curves_keep_their_extremes_when_thinned():
    x = np.arange(20000.0)
    y = np.random.default_rng(3).normal(size=x.size)
    keep = thin(x, y, 300)
    assert keep.size < 1300
    assert {int(np.argmax(y)), int(np.argmin(y)), 0, x.size - 1} <= set(keep.tolist())


def test_numbers_on_logarithmic_axes_are_readable():
    axes = new_axes()
    axes.set_yscale("log")
    axes.set_ylim(0.15, 0.8)  # less than a decade: 2 and 5 are numbered
    log_axis(axes.yaxis)
    axes.figure.canvas.draw()
    assert {"0.2", "0.5"} <= {t.get_text() for t in axes.get_yticklabels()}
    assert [number(v) for v in (0.0, 1234.5, 1.5e-6, -2e7)] == ["0", "1234", "1.50·10⁻⁶", "−2.00·10⁷"]


STEPS = [
    {"step": 0, "added": None, "error_db": 6.7, "heldout_error_db": 8.8, "heldout_misfit": 8e4},
    {"step": 1, "added": {"kind": "ground_spring", "location": ["2+Z"]}, "error_db": 0.4, "heldout_error_db": 0.2, "heldout_misfit": 0.95},
]
WHERE = {
    "by_dof": [{"dof": "1+Z", "error_db": 4.0, "misfit": 9.0}, {"dof": "2+Z", "error_db": 8.0, "misfit": 40.0}],
    "by_band": [{"band_hz": [5.0, 20.0], "error_db": 3.0, "misfit": 5.0}],
    "by_mode": [{"frequency_hz": 12.0, "height_error_db": -1.5}, {"frequency_hz": 20.0, "height_error_db": None}],
}


def a_diagnosis(**changes):
    from operando import Diagnosis

    curve = {"location": ["2+Z"], "frequency_hz": [5.0, 10.0], "real": [1e5, 1.1e5], "imag": [0.0, 9.0], "unit": "N/m"}
    given = {"verdict": "explained", "effects": (), "ambiguous_with": (), "proposed_measurement": None, "ladder": tuple(STEPS)}
    given |= {"candidates": (), "where": WHERE, "noise_floor_db": 0.26, "picture": {"dynamic_stiffness": [curve]}}
    return Diagnosis(**given | changes)


def test_a_diagnosis_draws_its_steps_on_axes_given_or_made():
    import matplotlib.pyplot as plt

    found = a_diagnosis()
    axes = found.plot_ladder()
    assert [bar.get_height() for bar in axes.patches] == [8.8, 0.2]
    assert [t.get_text() for t in axes.get_xticklabels()] == ["idle model", "+ ground_spring\n2+Z"]
    assert "noise floor 0.26 dB" in [t.get_text() for t in axes.get_legend().get_texts()]
    given = plt.figure().add_subplot()
    assert plots.plot_steps(found.to_dict(), given) is given  # diagnosis.json draws the same
    assert [bar.get_height() for bar in given.patches] == [8.8, 0.2]
    with pytest.raises(DataError, match="no steps"):
        a_diagnosis(ladder=()).plot_ladder()
    plt.close("all")


def test_a_diagnosis_from_responses_alone_draws_chi_square():
    import matplotlib.pyplot as plt

    rows = tuple({**row, "error_db": None, "heldout_error_db": None} for row in STEPS)
    where = {"by_mode": [], "by_dof": [{"dof": "1+Z", "error_db": None, "misfit": 9.0}]}
    found = a_diagnosis(ladder=rows, where=where, noise_floor_db=None)
    axes = found.plot_ladder()
    assert [bar.get_height() for bar in axes.patches] == [8e4, 0.95]
    assert axes.get_yscale() == "log"
    axes = found.plot_where()
    assert [bar.get_height() for bar in axes.patches] == [9.0]
    assert "χ²" in axes.get_ylabel()
    with pytest.raises(DataError, match="no errors by mode"):
        found.plot_where(by="mode")
    plt.close("all")


def test_a_diagnosis_draws_where_the_idle_model_fails():
    import matplotlib.pyplot as plt

    found = a_diagnosis()
    assert [bar.get_height() for bar in found.plot_where().patches] == [4.0, 8.0]
    assert found.plot_where(by="band").get_xlabel() == "Frequency band [Hz]"
    heights = [bar.get_height() for bar in found.plot_where(by="mode").patches]
    assert heights[0] == -1.5
    assert np.isnan(heights[1])
    with pytest.raises(DataError, match="not known"):
        found.plot_where(by="line")
    axes = found.plot_dynamic_stiffness()
    assert axes.get_title("left") == "Dynamic stiffness at 2+Z"
    assert np.array_equal(axes.lines[0].get_ydata(), [1e5, 1.1e5])
    with pytest.raises(DataError, match="1 locations, not number 1"):
        found.plot_dynamic_stiffness(number=1)
    plt.close("all")
