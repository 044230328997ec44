"""Objects that a user handles: indexing by DOF, short forms, other libraries, saving, typed errors, names that hide nothing."""

from __future__ import annotations

import json
import os
import pickle
import pkgutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import operando
from operando.compare import error_map
from operando.data import Channel, Frf, Geometry, ModalModel, TimeRecord, quantity_named
from operando.dof import Dof, DofIndex, named_dofs, parse_dofs
from operando.errors import DataError, DofError, FormatError, MissingError, ObjectError
from operando.io import write_uff
from structures import Chain

LINES = np.linspace(5.0, 60.0, 300)
SOURCE = Path(operando.__file__).resolve().parent


def matrix(references="1+Z, 3-Z", **options):
    rng = np.random.default_rng(5)
    n = len(parse_dofs(references))
    data = rng.normal(size=(3, n, LINES.size)) + 1j * rng.normal(size=(3, n, LINES.size))
    return Frf(data, LINES, "1+Z, 2+Z, 3-Z", references, variance=np.abs(data) ** 2 / 100, coherence=0.99 * np.ones(data.shape), **options)


def modal(**options):
    chain = Chain(n=4, mass=2.0, stiffness=1.2e5, zeta=0.01, seed=3)
    dofs = tuple(Dof(k + 1, "Z") for k in range(4))
    zeta = np.full(4, 0.01)
    return ModalModel(chain.hz, zeta, chain.phi, dofs, "unit_modal_mass", **options)


def record(**options):
    channels = (
        Channel(Dof(3, "Z", -1), "force", "N", "hammer"),
        Channel(Dof(3, "Z"), "acceleration", "m/s2", "acc 3"),
        Channel(Dof(4, "X"), "acceleration", "m/s2", "acc 4"),
        Channel(None, "voltage", "V", "tacho"),
    )
    return TimeRecord(np.arange(4.0)[:, None] + np.arange(100.0), 100.0, channels, **options)


# Indexing by DOF.


def test_frf_is_indexed_by_dof_and_sense():
    frf = matrix()
    one = frf["2+Z", "3+Z"]
    assert one.data.shape == (1, 1, LINES.size)
    assert np.array_equal(one.data[0, 0], -frf.data[1, 1])
    assert np.array_equal(one.variance[0, 0], frf.variance[1, 1])
    assert frf["2+Z"].references == frf.references
    assert frf[["1+Z", "3-Z"], "1+Z"].responses == parse_dofs("1+Z, 3-Z")
    assert frf["*+Z", :].responses == parse_dofs("1+Z, 2+Z")
    assert frf[:, "1+Z"].data.shape == (3, 1, LINES.size)
    for wrong in ("9+Z", ("1+Z", "7*")):
        with pytest.raises(DofError):
            frf[wrong]
    with pytest.raises(DofError, match="is no DOF label"):
        frf[0, 1]
    with pytest.raises(DataError, match="3 indices"):
        frf["1+Z", "1+Z", "1+Z"]


def test_record_is_indexed_by_dof_quantity_and_name():
    run = record()
    assert run["3+Z"].channels[0].quantity == "acceleration"  # a DOF means the sensor of motion
    assert run["3-Z:force"].channels[0].is_force
    turned = run["3-Z"]
    assert np.array_equal(turned.data[0], -run.data[1])
    assert turned.channels[0].label == "3-Z"
    assert run["tacho"].data[0, 0] == 3.0
    assert [c.name for c in run[["acc 4", "3+Z"]].channels] == ["acc 4", "acc 3"]
    assert [c.name for c in run["*Z"].channels] == ["hammer", "acc 3"]
    with pytest.raises(DofError, match="acc 4"):
        run["acc 5"]
    with pytest.raises(DofError, match=r"record.select\(\[0\]\)"):
        run[0]


def test_model_at_some_dofs_keeps_its_covariance():
    model = modal()
    p = model.n_parameters
    root = np.random.default_rng(2).normal(size=(p, p))
    full = modal(covariance=root @ root.T * 1e-8)
    part = full[["4-Z", "2+Z"]]
    assert np.allclose(part.shapes, full.rows("4-Z, 2+Z"))
    whole = full.frf(LINES, "4-Z", "2+Z")
    assert np.allclose(part.frf(LINES, "4-Z", "2+Z").variance, whole.variance)
    assert np.array_equal(full["*"].covariance, full.covariance)


def test_dof_index_finds_either_sense_and_names_what_is_near():
    index = DofIndex(parse_dofs("1+Z, 2-Z, 3+X"))
    assert index.common(parse_dofs("2+Z, 3+X, 9+Z")) == [(1, 0, -1), (2, 1, 1)]
    assert index.match(parse_dofs("3-X, 1+Z")) == ([2, 0], [-1, 1])
    assert (len(index), Dof(2, "Z") in index, "2+Z" in index) == (3, True, False)
    with pytest.raises(DofError, match=r"3\+Z is not measured \(did you mean"):
        index.match(parse_dofs("3+Z"))
    assert named_dofs("*", index.dofs) == index.dofs
    assert named_dofs("2+Z, *X", index.dofs) == parse_dofs("2+Z, 3+X")


# Verbs of FRFs.


def test_frf_verbs():
    frf = matrix()
    apart = frf["*", "1+Z"].beside(frf["*", "3-Z"])
    assert np.array_equal(apart.data, frf.data)
    assert np.array_equal(apart.coherence, frf.coherence)
    one, two = (replace(frf["*", d], name=f"at {d}") for d in ("1+Z", "3-Z"))
    assert (one.beside(two).name, one.beside(replace(two, name=one.name)).name) == ("", "at 1+Z")
    assert np.array_equal(frf.decimate(3).frequencies_hz, LINES[::3])
    assert len(frf.lines(LINES > 30).axis) == np.sum(LINES > 30)
    with pytest.raises(DataError, match="side by side"):
        frf.beside(frf.decimate(2))
    with pytest.raises(DataError, match="twice"):
        frf.beside(frf)
    with pytest.raises(DataError, match="step"):
        frf.decimate(0)


def test_quantities_by_their_other_names():
    frf = matrix("1+Z")
    compliance = frf.to_quantity("compliance")
    assert compliance.quantity == "receptance"
    assert Frf(frf.data, LINES, frf.responses, frf.references, "inertance").quantity == "accelerance"
    assert np.allclose(frf.values("dynamic stiffness") * compliance.data, 1)
    assert np.allclose(frf.values("apparent mass") * frf.data, 1)
    assert np.allclose(frf.values("mechanical impedance") * frf.to_quantity("mobility").data, 1)
    for model in (modal(), operando.Model(modal())):
        assert model.frf(LINES, quantity="compliance").quantity == "receptance"
    with pytest.raises(DataError, match=r"frf.values\('dynamic_stiffness'\)"):
        frf.to_quantity("dynamic_stiffness")
    with pytest.raises(DataError, match="did you mean 'receptance'"):
        quantity_named("receptence")


def test_models_take_what_frfs_give():
    """The axis of FRFs for their lines, and the patterns that FRFs are indexed by."""
    frf = matrix()
    for model in (modal(), operando.Model(modal())):
        made = model.frf(frf.axis, "1*", frf.references)
        assert made.axis == frf.axis
        np.testing.assert_array_equal(made.data, model.frf(frf.frequencies_hz, "1+Z", frf.references).data)


# Short forms.


def test_short_forms_are_short_and_harmless():
    nasty = "<script>alert(1)</script>\x1b[31m"
    for obj in (matrix(name=nasty), record(name=nasty), modal(), Geometry((1,), np.zeros((1, 3)), name=nasty)):
        assert len(repr(obj)) < 300
        assert "\x1b" not in repr(obj)
        page = obj._repr_html_()
        assert "<script" not in page
        assert "\x1b" not in page
        assert page.startswith("<table>")
    many = operando.ResidualTerms(np.arange(1.0, 41.0), np.full(40, 0.01), np.ones((12, 40)))
    assert repr(many) == "<ResidualTerms: 40 residual terms at 12 DOFs; at 1, 2, 3, … (40) Hz>"
    assert repr(matrix().axis).startswith("<FrequencyAxis: 300 lines, 5 to 60 Hz")
    assert repr(operando.ModalCoupling(np.zeros((9, 9)), np.zeros((4, 9)))) == "<ModalCoupling: 9 terms at 4 DOFs>"
    assert all(obj._repr_html_().startswith("<table>") for obj in (many, matrix().axis))
    assert repr(operando.catalogue()["clearance"]) == "<EffectKind: clearance; a stop with play on both sides>"
    assert repr(modal()).startswith("<ModalModel: 4 modes at ")
    assert "1 force 3-Z; 2 responses 3+Z, 4+X; 1 other channel" in repr(record())


def test_modes_that_are_not_there_are_refused():
    with pytest.raises(DataError, match=r"\[99\] names no modes of 4") as raised:
        modal().select_modes([99])
    assert raised.value.hint.startswith("give positions from 0")


def test_results_of_an_analysis_print_short():
    from operando import Diagnosis, Effect, Model
    from operando.diagnosis import Applied
    from operando.ema import EmaDetails
    from operando.results import CheckRun

    spring = Effect("ground_spring", "2+Z", {"stiffness": 2e4}, {"stiffness": 100.0})
    rows = [{"step": i, "heldout_error_db": v, "long": ["x"] * 1000} for i, v in enumerate((8.8, 0.2))]
    found = Diagnosis("explained", (spring,), (), "excite 3+Z while it runs", tuple(rows), tuple(rows), {"by_dof": rows}, 0.1, idle=modal())
    assert repr(found) == (
        "<Diagnosis: explained; ground_spring at 2+Z, 20.0 ± 0.2 kN/m; 0.20 dB on the hold-out set; proposed: excite 3+Z while it runs>"
    )
    model = Model(modal(), (spring,))
    assert repr(model) == "<Model: 4 idle modes at 4 DOFs; ground_spring at 2+Z, 20.0 ± 0.2 kN/m>"
    applied = Applied(model, (spring,), tuple(rows), ("words",))
    assert repr(applied) == "<Applied: ground_spring at 2+Z, 20.0 ± 0.2 kN/m; 8.80 dB before, 0.20 dB after on the hold-out set>"
    details = EmaDetails(None, (), (), (5.0, 60.0), np.ones(4), 1.0, True, False)
    for obj in (found, model, applied, details, CheckRun("run 1", "20 N", matrix(), 20.0)):
        assert len(repr(obj)) < 300
        assert obj._repr_html_().startswith("<table>")


# Saved, loaded, in other forms.


@pytest.mark.parametrize("obj", [matrix(), record(), modal(), Geometry((1, 2), np.eye(2, 3))], ids=lambda o: type(o).__name__)
def test_saved_objects_come_back(obj, tmp_path):
    obj.save(tmp_path / "one.h5")
    again = operando.load(tmp_path / "one.h5", type(obj))
    assert repr(again) == repr(obj)
    other = ModalModel if not isinstance(obj, ModalModel) else Frf
    with pytest.raises(ObjectError, match=f"a {type(obj).__name__} was saved"):
        operando.load(tmp_path / "one.h5", other)


def test_other_formats_say_what_they_lose(tmp_path):
    with pytest.warns(UserWarning, match="6 digits"):
        modal().save(tmp_path / "modes.uff")
    assert operando.read(tmp_path / "modes.uff").models[0].n_modes == 4
    with pytest.raises(FormatError, match="a ModalModel cannot be represented in csv"):
        modal().save(tmp_path / "modes.csv")
    with pytest.raises(FormatError, match="tells no format"):
        modal().save(tmp_path / "modes.docx")
    with pytest.raises(MissingError):
        operando.load(tmp_path / "nothing.h5")
    (tmp_path / "text.h5").write_text("no HDF5")
    with pytest.raises(FormatError):
        operando.load(tmp_path / "text.h5")


def test_a_file_of_another_format_is_not_called_damaged(tmp_path):
    matrix().save(tmp_path / "idle.uff")
    (tmp_path / "notes.txt").write_text("time [s],1+Z [g]\n0,1\n1,2\n")
    (tmp_path / "photo.raw").write_bytes(bytes(range(256)))
    for name, words in {"idle.uff": "in the format uff", "notes.txt": "a text, not", "photo.raw": "not an .h5 file of operando"}.items():
        with pytest.raises(FormatError, match=words) as refused:
            operando.load(tmp_path / name)
        assert "results folders; operando.read takes" in refused.value.hint
        assert "damaged" not in str(refused.value)
    matrix().save(tmp_path / "one.h5")
    whole = (tmp_path / "one.h5").read_bytes()
    for damaged in (whole[: len(whole) // 2], b"\0" * 8 + whole[8:]):
        (tmp_path / "one.h5").write_bytes(damaged)
        with pytest.raises(FormatError, match="damaged"):
            operando.load(tmp_path / "one.h5")


def test_results_are_saved_and_loaded(tmp_path):
    results = operando.Results("pump", idle=modal(), geometry=Geometry((1, 2), np.eye(2, 3)))
    results.save(tmp_path / "out")
    again = operando.load(tmp_path / "out", operando.Results)
    assert again.name == "pump"
    assert np.array_equal(again.idle.shapes, results.idle.shapes)
    assert repr(again) == "<Results: pump; 4 idle modes>"
    assert again.to_dict()["idle"]["modes"] == results.to_dict()["idle"]["modes"] != []


def test_tables_and_datasets():
    pytest.importorskip("pandas")
    frf, run, model = matrix(), record(), modal()
    assert frf.to_dataframe()["2+Z", "3-Z"].iloc[7] == frf.data[1, 1, 7]
    assert list(run.to_dataframe().columns) == ["3-Z", "3+Z", "4+X", "tacho"]
    assert model.to_dataframe().loc[1, "3+Z"] == model.shapes[2, 1]
    pytest.importorskip("xarray")
    made = frf.to_xarray()
    assert made.frf.sel(response="2+Z", reference="1+Z", frequency_hz=LINES[3]).item() == frf.data[1, 0, 3]
    assert made.attrs["unit"] == "(m/s²)/N"
    assert model.to_xarray()["shape"].sel(dof="2+Z", mode=1).item() == model.shapes[1, 1]
    assert run.to_xarray()["data"].shape == run.data.shape


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingError, match=r"xarray is not installed.*operando\[tables\]"):
        matrix().to_xarray()


def test_a_pattern_reads_all_files_in_natural_order(tmp_path):
    for k in (1, 2, 10):
        write_uff(tmp_path / f"run{k}.uff", record(name=f"run{k}"), *([Geometry((k,), np.zeros((1, 3)))] if k < 10 else []))
    content = operando.read(f"{tmp_path}/run*.uff")
    assert [Path(r.name).stem for r in content.records] == ["run1", "run2", "run10"]
    assert content.geometry.nodes == (1,)
    assert any(f.kind == "several_geometries" for f in content.findings)
    with pytest.raises(MissingError, match="no file matches"):
        operando.read(f"{tmp_path}/walk*.uff")


# Models side by side.


def test_models_are_compared_mode_by_mode():
    one = modal()
    moved = one.with_terms(frequencies_hz=one.frequencies_hz * [1.0, 1.02, 1.0, 1.0])["4-Z, 3+Z, 2+Z"]
    compared = operando.compare(one, moved)
    assert [round(m["frequency_percent"], 3) for m in compared.modes] == [0.0, 2.0, 0.0, 0.0]
    assert compared.n_dofs == 3
    assert min(m["mac"] for m in compared.modes) == pytest.approx(1.0)
    assert json.loads(json.dumps(compared.to_dict()))["only_first"] == []
    few = operando.compare(one, moved, (0.0, one.frequencies_hz[1] * 1.01))
    assert (len(few.modes), few.only_first) == (1, (1,))
    with pytest.raises(DataError, match="no DOF in common"):
        operando.mac(one, ModalModel([1.0], [0.01], [[1.0]], "9+X"))


def test_error_map_needs_the_same_lines():
    frf = matrix()
    assert np.allclose(error_map(Frf(2 * frf.data, LINES, frf.responses, frf.references), frf, [5, 30, 60]), 20 * np.log10(2))
    with pytest.raises(DataError, match="same pairs and lines"):
        error_map(frf.decimate(2), frf, [5, 60])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: operando.fit_ema(record()), "identified from FRFs, not TimeRecord"),
        (lambda: operando.estimate_frf([matrix()]), "estimated from time records, not Frf"),
        (lambda: operando.fit_oma("run.uff"), "time records, not str"),
        (lambda: operando.scale_operational(matrix(), modal()), "idle modes are needed first, not Frf"),
        (lambda: operando.compare(modal(), record()), "FRFs or another model, not TimeRecord"),
        (lambda: operando.compare(record(), matrix()), "makes no FRF"),
        (lambda: operando.mac(modal(), 3), "MAC of ModalModel and int"),
        (lambda: operando.plots.plot_frf(modal()), "FRFs can be drawn here, not ModalModel"),
        (lambda: operando.plots.plot_record(matrix()), "a time record can be drawn here"),
        (lambda: modal().plot_shape(0, "plate.uff"), "a str is no geometry"),
    ],
)
def test_wrong_objects_are_refused_in_words(call, words):
    with pytest.raises(ObjectError, match=words) as caught:
        call()
    assert caught.value.hint
    assert isinstance(caught.value, TypeError)


# Names.


def test_no_function_hides_a_package():
    """Where a function is called as its package, the package itself is what is called."""
    rooms = {m.name for m in pkgutil.iter_modules([str(SOURCE)])}
    for name in set(operando.__all__) & rooms:
        thing = getattr(operando, name)
        assert thing is sys.modules[f"operando.{name}"], f"operando.{name} hides the package"
    assert operando.compare(modal(), modal()).n_dofs == 4
    assert operando.compare.error_map is error_map
    assert "measured" in operando.compare.__doc__
    assert pickle.loads(pickle.dumps(operando.compare)) is operando.compare
    assert operando.structure.Model is operando.Model


def test_a_checker_sees_the_types(tmp_path):
    pytest.importorskip("mypy")
    assert (SOURCE / "py.typed").is_file()
    (tmp_path / "user.py").write_text(
        "import operando\n"
        'frf = operando.estimate_frf(operando.read("idle/*.uff").records)\n'
        "model = operando.fit_ema(frf, band=(5.0, 145.0))\n"
        'reveal_type(frf["7+Z", "12+Z"])\n'
        "reveal_type(frf.plot())\n"
        "reveal_type(operando.compare(model, frf))\n"
        "reveal_type(operando.compare(model, model))\n"
        'reveal_type(operando.load("out", operando.Results).idle)\n'
        "operando.fit_ema(model)\n"
        "operando.nonsense\n"
    )
    command = ["-m", "mypy", "--strict", "--follow-imports=silent", "--ignore-missing-imports", "--cache-dir", os.devnull, "user.py"]
    environment = {**os.environ, "MYPYPATH": str(SOURCE.parent)}
    told = subprocess.run([sys.executable, *command], cwd=tmp_path, env=environment, capture_output=True, text=True).stdout
    for words in (
        'user.py:4: note: Revealed type is "operando.data.frf.Frf"',
        'user.py:5: note: Revealed type is "matplotlib.axes._axes.Axes"',
        'user.py:6: note: Revealed type is "operando.compare.comparison.Comparison"',
        'user.py:7: note: Revealed type is "operando.compare.models.ModelComparison"',
        'user.py:8: note: Revealed type is "operando.data.modal.ModalModel | None"',
        'user.py:9: error: Argument 1 to "fit_ema" has incompatible type "ModalModel"',
        'user.py:10: error: Module has no attribute "nonsense"',
    ):
        assert words in told, told


def test_a_model_with_no_effect_applied_says_so():
    from operando.diagnosis import Applied

    assert repr(Applied(operando.Model(modal()), (), (), ())) == "<Applied: no effect>"
