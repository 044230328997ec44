"""Inputs that once ended in an untyped error: each is answered, or refused with a typed one."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest

import measurements
from nonlinear_truth import Strip, measure, place
from operando.config import load_test
from operando.data import LEVEL_RATIO, FrequencyAxis, Frf, ModalModel, level_groups, one_level
from operando.diagnosis import diagnose_records
from operando.dof import MAX_NUMBER_DIGITS, Dof
from operando.ema import fit_ema
from operando.ema.polished import polish_runs
from operando.ema.spectra import record_spectra
from operando.errors import ConfigError, DataError, DofError, IdentificationError, OperandoError
from operando.frf import estimate_frf
from operando.io import from_sep005
from operando.limits import LEAST_LINES
from operando.pipeline import run
from operando.scaling import scale_operational
from operando.scaling.missing import missing_modes
from operando.scaling.no_scale import no_scale
from operando.structure import Model
from operando.structure.effects import Effect

DOFS = tuple(Dof(i + 1, "Z") for i in range(4))


# one response


def test_one_response_under_a_level_dependent_effect():
    strip = Strip()
    records = measure(strip, [(place(strip, 2), "cubic_stiffness", {"coefficient": 1e8})], seconds=6.0, run_in=1.0)
    few = [r.select([*r.force_indices, r.response_indices[2]]) for r in records]
    found = diagnose_records(strip.idle(), few, kinds=["cubic_stiffness"])
    assert found.verdict in ("explained", "partial", "unexplained", "inconclusive", "ambiguous", "no_misfit")
    assert all(np.isfinite(list(e.values.values())).all() for e in found.effects)


# shapes of any size


def models():
    idle, running = measurements.idle_chain(), measurements.running_chain()
    covariance = np.eye(4 * (2 + 4)) * 1e-6
    first = ModalModel(idle.hz, np.full(4, 0.01), idle.phi, DOFS, "unit_modal_mass", covariance=covariance, band_hz=(5.0, 90.0))
    return first, ModalModel(
        running.hz, np.full(4, 0.01), running.phi.astype(complex), DOFS, covariance=np.eye(40) * 1e-6, band_hz=(5.0, 90.0)
    )


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_the_scale_of_operational_shapes_does_not_matter(scale):
    idle, operating = models()
    plain = scale_operational(idle, replace(operating, covariance=None))
    scaled = scale_operational(idle, replace(operating, shapes=operating.shapes * scale, covariance=None))
    np.testing.assert_allclose(np.abs(scaled.modal.shapes), np.abs(plain.modal.shapes), rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-300, 1e-160, 1e100, 1e200])
@pytest.mark.parametrize("which", ["idle", "operational"])
def test_shapes_that_no_measurement_has(scale, which):
    idle, operating = models()
    if which == "idle":
        idle = replace(idle, shapes=idle.shapes * scale)
    else:
        operating = replace(operating, shapes=operating.shapes.real * scale, covariance=None)
    with pytest.raises(DataError, match=f"the {which} shape of the mode at .* has the size") as caught:
        scale_operational(idle, operating)
    assert "units" in caught.value.hint


def test_participations_that_are_no_numbers():
    with pytest.raises(IdentificationError, match="no finite part"):
        missing_modes(np.full((3, 2), np.nan), np.arange(1.0, 4.0), np.arange(3), (1.0, 5.0), True)


# no mode, no line


def noise_frf(hz):
    rng = np.random.default_rng(3)
    data = rng.normal(size=(4, 1, hz.size)) + 1j * rng.normal(size=(4, 1, hz.size))
    return Frf(data, FrequencyAxis(hz), DOFS, DOFS[:1], "accelerance", variance=np.full(data.shape, 2.0))


def test_frfs_of_noise_hold_no_mode():
    with pytest.raises(IdentificationError):
        fit_ema(noise_frf(np.arange(1.0, 100.0, 0.25)), band=(10.0, 90.0))


def test_an_answer_without_a_mode_is_refused(monkeypatch):
    hz = np.arange(1.0, 100.0, 0.25)
    frf = Frf(measurements.idle_chain().accelerance(hz, ref=(0,)), FrequencyAxis(hz), DOFS, DOFS[:1], "accelerance")
    empty = ModalModel([], [], np.zeros((4, 0)), DOFS, "unit_modal_mass")
    monkeypatch.setattr("operando.ema.fit._identify", lambda job, order: empty)
    with pytest.raises(IdentificationError, match="no mode is found between 10 and 90 Hz") as caught:
        fit_ema(frf, band=(10.0, 90.0))
    assert "modes_hz" in caught.value.hint
    assert not np.any(empty.frf([1.0, 2.0]).data)  # no mode: no motion


@pytest.mark.parametrize("band", [(200.0, 300.0), (10.0, 10.5)])
def test_a_band_outside_the_lines(band):
    with pytest.raises(IdentificationError, match=f"holds [0-{LEAST_LINES - 1}] lines of the FRFs"):
        fit_ema(noise_frf(np.arange(1.0, 100.0, 0.25)), band=band)


def test_spectra_without_a_line_in_the_band():
    record = measurements.record(measurements.idle_chain(), [0], 5.0, 1, "run1", seconds=4.0)
    spectra = record_spectra(record, DOFS, (10.0, 90.0))
    with pytest.raises(IdentificationError, match="no line within 300-400 Hz; the spectra hold 10-90 Hz") as caught:
        spectra.band(300.0, 400.0)
    assert caught.value.where == "run1"


def test_a_report_is_written_where_no_mode_was_found(tmp_path, monkeypatch):
    path = measurements.write_test(tmp_path, check=False, operating=False)
    monkeypatch.setattr("operando.ema.fit._identify", lambda job, order: ModalModel([], [], np.zeros((4, 0)), DOFS))
    results = run(path, tmp_path / "out")
    assert "no mode is found" in results.left_out["ema"]
    assert "no mode is found" in (tmp_path / "out/report.html").read_text(encoding="utf-8")
    assert (tmp_path / "out/idle_frf.uff").exists()


# exclude_bands acts on everything that is fitted


def test_excluded_bands_are_left_out_of_frfs_and_records():
    record = measurements.record(measurements.idle_chain(), [0], 5.0, 1, "run1", seconds=8.0)
    hz = np.arange(1.0, 100.0, 0.25)
    frf = Frf(measurements.idle_chain().accelerance(hz, ref=(0,)), FrequencyAxis(hz), DOFS, DOFS[:1], "accelerance")
    for records in ([record], None):
        whole, _ = polish_runs(frf, DOFS, (10.0, 90.0), records)
        cut, _ = polish_runs(frf.without_bands([(40.0, 50.0)]), DOFS, (10.0, 90.0), records, [(40.0, 50.0)])
        assert np.any((whole[0].frequencies_hz > 41) & (whole[0].frequencies_hz < 49))
        assert not np.any((cut[0].frequencies_hz >= 40) & (cut[0].frequencies_hz <= 50))


def test_a_disturbance_in_an_excluded_band_is_not_fitted():
    chain = measurements.idle_chain()
    record = measurements.record(chain, [0], 5.0, 1, "run1")
    seconds = np.arange(record.n_samples) / measurements.FS
    data = record.data.copy()
    data[1:] += 0.3 * data[1:].std() * np.sin(2 * np.pi * 53.3 * seconds)
    disturbed = replace(record, data=data)
    frf = estimate_frf([disturbed], estimator="h1", block_seconds=6.0)
    asked = {"band": (10.0, 90.0), "records": [disturbed], "ema": "polished"}
    whole, cut = (fit_ema(frf, exclude_bands=bands, **asked) for bands in ((), [(51.5, 55.5)]))
    assert cut.misfit < 10  # what is left leaks out of the band
    assert whole.misfit > 10 * cut.misfit
    np.testing.assert_allclose(cut.frequencies_hz, chain.hz, rtol=1e-4)


# what the lines do not tell has an infinite standard deviation


def test_the_standard_deviation_of_what_no_line_tells_is_infinite():
    unknown = Effect("ground_spring", DOFS[2:3], {"stiffness": 3e4}, {"stiffness": np.inf})
    assert unknown.to_dict()["parameters"]["stiffness"]["std"] is None
    idle, _ = models()
    assert np.isfinite(Model(replace(idle, covariance=None), (unknown,)).frf([20.0, 30.0]).data).all()


# one ratio splits force levels


def test_force_levels_are_split_by_one_ratio_everywhere():
    assert 1.25 < LEVEL_RATIO < np.sqrt(2)  # above the scatter of one setting, below 3 dB
    assert one_level(1.0, LEVEL_RATIO * 0.999)
    assert one_level(LEVEL_RATIO * 0.999, 1.0)
    assert not one_level(1.0, np.sqrt(2))
    assert one_level(0.0, 0.0)
    assert not one_level(0.0, 1.0)
    from operando.diagnosis.records import make_case

    strip = Strip()
    base = measure(strip, [(place(strip, 2), "ground_spring", {"stiffness": 1e3})], seconds=2.0, run_in=1.0)[0]
    for ratio, levels in ((LEVEL_RATIO * 0.98, 1), (LEVEL_RATIO * 1.02, 2)):
        pair = [base, replace(base, data=base.data * ratio, name="louder")]
        assert len(level_groups(pair)) == levels
        case = make_case(strip.idle(), pair, places=[(2,)])
        assert [len(case.fitted), len(case.validation)] == [1, 1]
        assert ("louder" in {r.name for r in case.validation}) is (levels == 1)  # of two levels the lower one validates


# DOF labels


@pytest.mark.parametrize("text", ["9" * 100_000 + "+Z", "9" * 19, "1" + "0" * 18 + "-a"])
def test_node_numbers_of_many_digits(text):
    assert 10**MAX_NUMBER_DIGITS < 2**63 < 10 ** (MAX_NUMBER_DIGITS + 1)  # the longest that always fits 64 bits
    assert Dof.parse("9" * MAX_NUMBER_DIGITS + "+Z").number == 10**MAX_NUMBER_DIGITS - 1
    with pytest.raises(DofError, match="digits") as caught:
        Dof.parse(text)
    assert len(str(caught.value)) < 300
    with pytest.raises(DofError, match="18 digits"):
        Dof(10**18, "Z")
    assert 10**MAX_NUMBER_DIGITS < 2**63 < 10 ** (MAX_NUMBER_DIGITS + 1)  # as many as fit 64 bits
    assert Dof.parse("9" * MAX_NUMBER_DIGITS).number == 10**MAX_NUMBER_DIGITS - 1


def test_leading_zeros_are_no_digits():
    assert Dof.parse("0" * 5000 + "12+Z") == Dof(12, "Z")


# SEP005 and the test file under a seeded mutator

WRONG = (None, "", "abc", b"x", -1, 0, 1e400, float("nan"), 10**400, [], {}, [1, 2], [[1, 2], [3]], [1, "a"], np.zeros((2, 2)), object())
WRONG += (np.array([1j, 2]), True, "1" * 5000, [None, 1.0], np.full(64, np.nan), range(64), "\x00", np.datetime64("2020"), len, 3 + 4j)


def test_sep005_of_any_content_is_read_or_refused():
    rng = random.Random(5)
    refused = 0
    for _ in range(1000):
        items = [
            {"data": np.arange(64.0), "fs": 64.0, "name": f"{i + 1}+Z", "unit_str": "m/s2", "time": np.arange(64) / 64} for i in range(2)
        ]
        for _ in range(rng.randint(1, 3)):
            item = items[rng.randrange(2)]
            key = rng.choice(["data", "fs", "name", "unit_str", "time", "start"])
            item[key] = rng.choice(WRONG)
        try:
            made = from_sep005(rng.choice([items, items, items[0], rng.choice(WRONG)]))
        except OperandoError:
            refused += 1
        else:
            assert made.sampling_hz > 0
    assert 500 < refused < 1000


VALUES = ("true", "-1", "0", "1e400", "nan", "inf", "[]", "{}", '""', '"x"', "[1, 2]", "[[1]]", '[["a"]]', "1979-05-27", "9" * 400)
VALUES += ("[1e400, 2]", '"\\u0000"', '"' + "a/" * 3000 + '"', '["**"]', '["["]', "[{file = 3}]", '"²"', "[true]", "{quantity = [1]}")
VALUES += ('{dof = "' + "9" * 5000 + '"}',)
SECTIONS = {
    "": ["name", "idle", "analysis"],
    "idle": ["records", "frfs"],
    "geometry": ["file", "units"],
    "units": ["force", "length", "sampling_hz"],
    "channels": ["acc1", '"1+Z"'],
    "directions": ['"5+a"', '"1+X"'],
    "analysis": ["band", "block_seconds", "overlap", "window", "hits_reject", "references", "max_order", "modes_hz", "threshold", "scaling",
                 "exclude_bands", "kinds", "places", "second_opinion", "estimator"],
}  # fmt: skip


def test_a_test_file_of_any_content_is_read_or_refused(tmp_path):
    (tmp_path / "run.uff").write_bytes(b"x")
    rng = random.Random(7)
    refused: list[ConfigError] = []
    for _ in range(600):
        section = rng.choice(list(SECTIONS))
        key = rng.choice(SECTIONS[section])
        lines = ["[operating]", 'records = ["run.uff"]']
        given = [f"{key} = {rng.choice(VALUES)}"]
        lines = [*given, *lines] if not section else [*lines, f"[{section}]", *given]
        text = "\n".join(lines)
        if rng.random() < 0.2:  # a byte somewhere
            at = rng.randrange(len(text))
            text = text[:at] + rng.choice("[]={}\"'\\\n,.#\x07é") + text[at + 1 :]
        (tmp_path / "test.toml").write_text(text, encoding="utf-8")
        try:
            load_test(tmp_path)
        except ConfigError as error:
            refused.append(error)
    assert len(refused) > 400
    assert all(str(tmp_path) in (error.where or "") for error in refused)
    assert max(len(str(error)) for error in refused) < 8000


def test_a_nesting_without_end_is_refused(tmp_path):
    (tmp_path / "test.toml").write_text("a = " + "[" * 5000, encoding="utf-8")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_test(tmp_path)


# the true cause of a missing scale


@pytest.mark.parametrize(
    ("kinds", "si", "cause", "advice"),
    [
        ([("swapped", "1+Z and 3+Z are exchanged", "check the cables")], True, "1+Z and 3+Z are exchanged", "check the cables"),
        ([("missing_drive_point", "no response on 1+Z", "measure the response")], True, "no response on 1+Z", "measure the response"),
        ([("missing_unit", "no unit of acc1", "")], False, "no unit of acc1", "[units]"),
        ([], True, "no drive point shows the modes", "move the force"),
    ],
)
def test_the_cause_of_a_missing_scale_is_the_one_found(kinds, si, cause, advice):
    from operando.data import Finding

    idle = replace(models()[0], scaling="unscaled", si=si)
    found = no_scale(idle, [Finding(kind, message, action=action) for kind, message, action in kinds])
    assert found is not None
    assert cause in found[0]
    assert advice in found[1]
    assert no_scale(models()[0], []) is None
