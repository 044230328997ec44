"""What the output-only diagnosis accepts: the idle model it starts from, the second half's veto, standard deviations, forced ambiguity."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from operando.data import ModalModel
from operando.diagnosis.output_only import diagnose_output_only, likeliest
from operando.diagnosis.output_only_fit import SAMPLED, excess, fit
from operando.diagnosis.output_only_forward import Basis, action_of
from operando.diagnosis.output_only_idle import completion, settled
from operando.diagnosis.output_only_residuals import target_of
from operando.diagnosis.output_only_sets import Sets, partners, sets_of
from operando.effects import Effect
from operando.report.words_diagnosis import FAINT, diagnosis_words
from test_diagnose_output_only import DOFS, IN_BAND, SENSORS, chain, idle_of, running

DRIVEN = (0, 4)


def out_of_band(model, s, rows=slice(None), columns=slice(None)):
    """Receptance of the modes above the band at ω = s."""
    up = model.terms.frequencies_hz > model.band_hz[1]
    w = 2 * np.pi * model.terms.frequencies_hz[up]
    phi = np.asarray(model.terms.shapes)[:, up]
    return ((phi / (w**2 - s**2)) @ phi.T)[rows, columns]


def badly_completed(c):
    """Residual modes that are right in the driven columns and far too large at undriven DOFs, with a covariance that hides it."""
    true = idle_of(c, scatter=0.0)
    m = len(SENSORS)
    undriven = np.array([i for i in range(m) if i not in DRIVEN])
    rms = float(np.sqrt(np.mean(true.terms.shapes[:, :IN_BAND] ** 2)))
    top = true.band_hz[1]
    wild = np.zeros((m, 2))
    wild[undriven] = 12 * rms * np.random.default_rng(4).standard_normal((undriven.size, 2))
    local = np.zeros((m, undriven.size))
    local[undriven, np.arange(undriven.size)] = rms
    shapes = np.concatenate([true.terms.shapes, wild, local], axis=1)
    n = shapes.shape[1]
    hz = np.r_[true.terms.frequencies_hz, 1.7 * top, 2.4 * top, np.full(undriven.size, 2 * top)]
    std = np.full((n, m), 1e-3 * rms)
    return true, ModalModel.from_terms(
        hz,
        np.full(n, 0.01),
        shapes,
        DOFS,
        scaling="unit_modal_mass",
        # The first mode above the band has been identified.
        residual=np.arange(n) > IN_BAND,
        in_band=np.arange(n) < IN_BAND,
        covariance=np.diag(np.r_[np.full(2 * n, 1e-8), (std**2).ravel()]),
        band_hz=true.band_hz,
    )


def test_settled_keeps_what_was_driven_and_bounds_what_was_not():
    true, bad = badly_completed(chain())
    calm = settled(bad)
    u = np.array([i for i in range(len(SENSORS)) if i not in DRIVEN])
    for share in (0.3, 0.6, 0.9):
        s = share * 2 * np.pi * true.band_hz[1]
        exact, before, after = (out_of_band(model, s) for model in (true, bad, calm))
        size = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
        assert np.abs((after - exact) / size)[:, DRIVEN].max() < 0.1
        assert np.median(np.diag(before)[u] / np.diag(exact)[u]) > 15
        ratio = np.diag(after)[u] / np.diag(exact)[u]
        assert ratio.min() > 0.2
        assert ratio.max() < 6
    np.testing.assert_allclose(calm.shapes, bad.shapes)
    assert np.linalg.eigvalsh(calm.covariance).min() > -1e-12
    # The local modes say how little is known there: as much again, or nothing.
    calm = calm.terms
    local = np.count_nonzero(calm.shapes, axis=0) == 1
    k = int(np.flatnonzero(local)[0])
    assert calm.shape_std[:, k].max() == pytest.approx(np.abs(calm.shapes[:, k]).max())
    assert np.all(calm.shape_std[list(DRIVEN)][:, local] == 0)


@pytest.mark.parametrize("known", [True, False])
def test_an_identified_mode_the_drive_points_hardly_see_stays_if_it_is_known(known):
    _, bad = badly_completed(chain())
    n, m = bad.terms.n, len(bad.dofs)
    shapes = np.array(bad.terms.shapes)
    shapes[list(DRIVEN), IN_BAND] *= 0.05
    covariance = np.array(bad.covariance)
    at = 2 * n + IN_BAND * m + np.arange(m)
    covariance[at, at] = (1e-3 if known else 0.6) ** 2 * np.mean(shapes[:, IN_BAND] ** 2)
    calm = settled(bad.with_terms(shapes=shapes, covariance=covariance, std=None))
    stays = np.any(np.abs(calm.terms.frequencies_hz - bad.terms.frequencies_hz[IN_BAND]) < 1e-9)
    assert stays == known


def test_settled_leaves_models_alone_that_have_no_local_modes():
    idle = idle_of(chain())
    assert settled(idle) is idle
    bare = replace(badly_completed(chain())[1], covariance=None)
    assert settled(bare) is bare


def test_completion_is_the_smallest_positive_matrix_with_the_columns():
    rng = np.random.default_rng(0)
    driven = np.arange(6) < 2
    half = rng.standard_normal((6, 2))
    whole = half @ half.T
    got = completion(whole[:, :2], driven)
    np.testing.assert_allclose(got @ got.T, whole, atol=1e-9)
    more = np.r_[np.zeros((2, 3)), rng.standard_normal((4, 3))]
    more = whole + more @ more.T
    got = completion(more[:, :2], driven)
    np.testing.assert_allclose((got @ got.T)[:, :2], more[:, :2], atol=1e-9)
    assert np.linalg.eigvalsh(more - got @ got.T).min() > -1e-9


SPRING = ("ground_spring", ("2+Z",), 2e4)
KINDS = ("ground_spring", "ground_damper")


def test_the_second_half_refuses_what_it_does_not_show():
    c = chain()
    idle, with_it, without = idle_of(c), running(c, SPRING, seed=1), running(c, seed=2)
    both = diagnose_output_only(idle, running(c, SPRING), halves=(with_it, running(c, SPRING, seed=2)), kinds=KINDS)
    assert both.verdict == "explained"
    assert [str(e.location[0]) for e in both.effects] == ["2+Z"]
    first_alone = diagnose_output_only(idle, running(c, SPRING), halves=(with_it, without), kinds=KINDS)
    assert first_alone.effects == ()
    assert len(first_alone.ladder) == 1
    second_alone = diagnose_output_only(idle, running(c, SPRING), halves=(without, with_it), kinds=KINDS)
    assert second_alone.effects == ()
    assert second_alone.verdict == "unexplained"


def test_where_the_better_half_chose_and_the_poorer_one_could_not_confirm_the_halves_change_places():
    c, spring = chain(), ("ground_spring", ("2+Z",), 5e3)
    idle, whole = idle_of(c), running(c, spring)
    good, noisy = running(c, spring, seed=1), running(c, spring, seed=2, noise=4.0)
    std = {"frequencies_hz": noisy.frequency_std_hz, "damping_ratios": noisy.damping_ratio_std, "shapes": noisy.shape_std}
    wide = {name: 4.0 * value for name, value in std.items()}
    poor = ModalModel(noisy.frequencies_hz, noisy.damping_ratios, noisy.shapes, noisy.dofs, std=wide)
    found = diagnose_output_only(idle, whole, halves=(good, poor), kinds=KINDS)
    assert [(e.kind, str(e.location[0])) for e in found.effects] == [("ground_spring", "2+Z")]
    assert found.notes[0].startswith("the second half of the record chose the effects, the first, identified apart, judged them")
    sets = sets_of(idle, whole, (good, poor))
    assert sets.exchanged().judge is sets.choose
    assert sets.exchanged().part == 2 * sets.part


def test_what_one_half_cannot_tell_apart_both_decide():
    c = chain()
    idle = idle_of(c)
    sets, basis = sets_of(settled(idle), running(c, SPRING), [running(c, SPRING, seed=k) for k in (1, 2)]), Basis.of(settled(idle))
    right, wrong = (action_of(Effect("ground_spring", (d,)), settled(idle)) for d in ("2+Z", "5+Z"))
    fits = [fit(sets.choose, basis.touched(a.rows), [a], [2e4], sets.use) for a in (wrong, right)]
    best, others = likeliest(sets, basis, fits[0], fits[1:])
    assert best is fits[1]
    assert others == fits[:1]
    assert likeliest(sets, basis, fits[0], []) == (fits[0], [])


def test_a_mode_that_one_half_alone_shows_decides_nothing():
    c = chain()
    idle, whole, first, second = idle_of(c), running(c, SPRING), running(c, SPRING, seed=1), running(c, SPRING, seed=2)
    twice = _with_spurious(second, 3)
    assert partners(twice, whole).sum() == IN_BAND
    assert partners(second, whole).all()
    found = diagnose_output_only(idle, whole, halves=(first, twice), kinds=KINDS)
    plain = diagnose_output_only(idle, whole, halves=(first, second), kinds=KINDS)
    assert found.verdict == "explained"
    assert "1 mode that one half alone showed" in found.notes[0]
    assert found.ladder[-1]["heldout_misfit"] == pytest.approx(plain.ladder[-1]["heldout_misfit"])


def _with_spurious(model, k):
    """The same modes and a twin of one of them, 0.6 % off and with another shape."""
    n, m = model.n_modes, len(model.dofs)
    shape = np.asarray(model.shapes)[:, k] * (1 + 0.5 * np.cos(np.arange(m)))
    order = lambda values, more: np.insert(np.asarray(values), k, more, axis=-1)  # noqa: E731
    std = {
        "frequencies_hz": order(model.frequency_std_hz, 0.01),
        "damping_ratios": order(model.damping_ratio_std, 1e-3),
        "shapes": order(model.shape_std, np.full(m, 3e-3)),
    }
    hz = order(model.frequencies_hz, 0.994 * model.frequencies_hz[k])
    assert hz.size == n + 1
    return ModalModel(hz, order(model.damping_ratios, 0.01), order(model.shapes, shape), model.dofs, std=std)


def stand_in(rows, held):
    """Sets with so many degrees of freedom that choose and judge; nothing else of them is used here."""
    sets = object.__new__(Sets)
    object.__setattr__(sets, "apart", True)
    object.__setattr__(sets, "part", 0.12)
    # 6 modes of 4 + 2·16 values and 2 less for the scale would do: the counts are made directly.
    object.__setattr__(sets, "use", _counted(rows))
    object.__setattr__(sets, "held", _counted(held))
    return sets


def _counted(number):
    """Rows in use that count as ``number`` degrees of freedom: one of each mode's frequencies."""
    use = np.zeros((number, 4), bool)
    use[:, 0] = True
    return use


def test_confirmation_compares_falls_not_misfits():
    sets = stand_in(200, 200)
    # 60 of the first half, 40 of the second: confirmed, however much a mode that nothing fits adds to both.
    for beyond in (0.0, 20.0):
        assert sets.confirms(1.0 + beyond, 0.8 + beyond, 60.0)
    # A fall that chance explains, or one far smaller than the first half's.
    assert not sets.confirms(1.0, 1.0 - 6 / 200, 20.0)
    assert not sets.confirms(21.0, 21.0 - 100 / 200, 4000.0)
    # A small part of what is left, however sure; with changed places twice as much is asked.
    assert not sets.confirms(1.0, 0.9, 60.0)
    assert sets.confirms(1.0, 0.8, 60.0)
    object.__setattr__(sets, "part", 0.24)
    assert not sets.confirms(1.0, 0.8, 60.0)
    object.__setattr__(sets, "part", 0.12)
    # Fewer rows judge: so much less may be asked of them.
    assert stand_in(200, 100).confirms(1.0, 1.0 - 15 / 100, 100.0)


def test_little_evidence_makes_the_set_wide():
    sets = stand_in(200, 200)
    fits = [SimpleNamespace(misfit=x) for x in (0.60, 0.68, 0.75)]
    best, near, far = fits
    # Before: 0.95. The best takes 70 of 200·0.95 away, the others 54 and 40.
    strong = sets.alike(0.95, best, [near, far], 0.95, [0.60, 0.70, 0.72])
    assert strong == []
    weak = sets.alike(0.95, best, [near, far], 0.80, [0.63, 0.70, 0.72])
    assert weak == [near]
    # What the second half likes better belongs to it where the first half hardly minds; it never becomes the best.
    close = [SimpleNamespace(misfit=x) for x in (10.0, 12.0, 30.0)]
    assert sets.alike(80.0, close[0], close[1:], 80.0, [11.0, 10.5, 10.0]) == [close[1]]
    assert sets.alike(80.0, close[0], close[1:], 80.0, [11.0, 12.5, 30.0]) == []


@pytest.mark.parametrize(("seed", "size"), [(1, 3.0), (0, 4.0)])
def test_a_damper_that_hardly_shows_is_ambiguous_with_the_others(seed, size):
    c = chain(seed)
    idle, truth = idle_of(c, seed), ("ground_damper", ("5+Z",), size)
    whole, *halves = (running(c, truth, seed=10 * seed + k) for k in range(3))
    found = diagnose_output_only(idle, whole, halves=halves, kinds=("ground_damper", "coupling_damper"))
    held = [row["heldout_misfit"] for row in found.ladder]
    assert 0 < (held[0] - held[1]) * sets_of(idle, whole, halves).held_rows < 50
    assert found.verdict == "ambiguous"
    assert any((e.kind, str(e.location[0])) == ("ground_damper", "5+Z") for e in (*found.effects, *found.ambiguous_with))
    assert "measure" in found.proposed_measurement


@pytest.mark.parametrize(("size", "named"), [(2.0, True), (0.0, False)])
def test_what_both_halves_speak_for_too_faintly_is_named_as_not_excluded(size, named):
    c = chain(1)
    idle, truth = idle_of(c, 1), ("ground_damper", ("5+Z",), size) if size else None
    whole, *halves = (running(c, truth, seed=10 + k) for k in range(3))
    found = diagnose_output_only(idle, whole, halves=halves, kinds=("ground_damper", "coupling_damper"))
    assert (found.verdict, found.effects) == ("no_misfit", ())
    assert [(e.kind, e.place) for e in found.ambiguous_with] == ([("ground_damper", "5+Z")] if named else [])
    assert any("do not tell ground_damper at 5+Z from nothing" in note for note in found.notes) == named
    assert (found.proposed_measurement or "").startswith("measure FRFs in operation with a force at 5+Z") == named
    told = diagnosis_words(found.to_dict())
    assert (told.title == FAINT[0]) == named
    assert any("but not excluded" in s for s in told.sentences) == named


def test_standard_deviations_count_what_modes_share():
    """All frequencies off by one common factor: a global stiffness learns nothing from their number."""
    c = chain()
    idle = idle_of(c, scatter=0.0)
    operating = running(c, ("global_stiffness", (), -0.06), noise=0.0)
    target = target_of(idle, operating)
    action = action_of(Effect("global_stiffness"), idle)
    use = np.ones((target.n, target.per_mode), bool)
    alone = fit(target, Basis.of(idle), [action], [-0.05], use)
    shared = np.array(target.joint)
    shared[:, 0, :, 0] = np.outer(target.std_log_hz, target.std_log_hz)
    together = fit(replace(target, joint=shared), Basis.of(idle), [action], [-0.05], use)
    np.testing.assert_allclose(together.sizes, alone.sizes)
    # d ln f = change / 2 / (1 + change): the least squares of n equal frequencies, and of n copies of one.
    one = 2 * (1 - 0.06) * float(np.mean(target.std_log_hz))
    assert alone.std[0] == pytest.approx(SAMPLED * one / np.sqrt(target.n), rel=0.03)
    assert together.std[0] == pytest.approx(SAMPLED * one, rel=0.03)


def test_sizes_scatter_as_their_standard_deviations_say():
    z = []
    for seed in range(12):
        c = chain(seed)
        idle = idle_of(c, seed)
        target = target_of(idle, running(c, SPRING, seed=seed))
        action = action_of(Effect("ground_spring", ("2+Z",)), idle)
        found = fit(target, Basis.of(idle), [action], [1.5e4], np.ones((target.n, target.per_mode), bool))
        z.append((found.sizes[0] - SPRING[2]) / found.std[0])
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.3


def test_residuals_larger_than_expected_widen_the_sizes():
    assert excess(0.4) == 1.0
    assert excess(4.0) == 2.0
    c = chain()
    idle, operating = idle_of(c, scatter=0.0), running(c, SPRING)
    action = action_of(Effect("ground_spring", ("2+Z",)), idle)
    target = target_of(idle, operating)
    use = np.ones((target.n, target.per_mode), bool)
    honest = fit(target, Basis.of(idle), [action], [2e4], use)
    bold = replace(
        target,
        std_log_hz=target.std_log_hz / 3,
        std_log_zeta=target.std_log_zeta / 3,
        covariance=target.covariance / 9,
        joint=target.joint / 9,
    )
    claimed = fit(bold, Basis.of(idle), [action], [2e4], use)
    assert claimed.misfit > 4
    # Claimed a third, but the residuals say what they are.
    assert claimed.std[0] == pytest.approx(honest.std[0], rel=0.35)
