"""Kinds of effects of the user's own: from the test file and the command line; the command that lists the catalogue."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from click.testing import CliRunner

import measurements
from operando import Effect, EffectKind, ModalModel, Model, Parameter, catalogue, load, load_test
from operando.cli import main
from operando.errors import ConfigError, FormatError, IdentificationError
from operando.own_effects import load_effects
from operando.pipeline import run
from operando.structure.effects import register, unregister

pytestmark = pytest.mark.usefixtures("own_kinds_gone")

LAW = '''
import operando

@operando.register
class Strut(operando.EffectKind):
    """Z = k·(1 + s·T)."""

    kind = "{kind}"
    plain = "a strut"
    parameters = (operando.Parameter("stiffness", "N/m", 1.0, 1e9, "log", 1e4, "stiffness"),)

    def dynamic_stiffness(self, s, values):
        return values["stiffness"] * (1 + {time} * s)
'''


def call(*args):
    return CliRunner().invoke(main, [str(a) for a in args])


def law(folder, name="my_laws.py", kind="strut_for_test", time=0.001):
    path = folder / name
    path.write_text(LAW.format(kind=kind, time=time), encoding="utf-8")
    return path


@pytest.fixture
def test_file(tmp_path):
    return measurements.write_test(
        tmp_path, operating=False, check=False, extra='kinds = ["strut_for_test"]\n[effects]\nmodules = ["my_laws.py"]'
    )


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A test without an operating record, run until the comparison: its test file, and results to copy."""
    path = measurements.write_test(tmp_path_factory.mktemp("compared"), operating=False)
    run(path, path.parent / "out", until="compare")
    return path


@pytest.fixture
def out(compared, tmp_path):
    return shutil.copytree(compared.parent / "out", tmp_path / "out")


def test_the_test_file_brings_its_own_kinds(tmp_path, test_file):
    law(tmp_path)
    test = load_test(test_file)
    assert "strut_for_test" in catalogue()
    assert test.effects == (tmp_path / "my_laws.py",)
    assert test.settings()["effects"] == {"modules": ["my_laws.py"]}
    assert test.analysis.kinds == ("strut_for_test",)
    load_test(test_file)  # a second time as the first


def test_a_changed_law_is_another_diagnosis(tmp_path, test_file):
    from operando.pipeline.runner import _Run  # the key alone: a diagnosis takes long

    class Folder:
        path = tmp_path

    keys = []
    for time in (0.001, 0.002):
        law(tmp_path, time=time)
        from operando.pipeline.stages import STEPS

        keys.append({step.name: _Run(load_test(test_file), Folder(), print)._key(step) for step in STEPS})
    assert {name for name in keys[0] if keys[0][name] != keys[1][name]} == {"diagnose"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "there is no file"),
        ("x = 1\ny = z\n", "line 2 cannot be imported: NameError"),
        ("def f(:\n", "line 1 cannot be imported: SyntaxError"),
        ("raise SystemExit\n", "line 1 cannot be imported: SystemExit"),
        ("x = 1\n", "registers no kind"),
        (LAW.format(kind="ground_spring", time=0), "registers 'ground_spring', which is there already"),
        (LAW.format(kind="two words", time=0), "needs a kind"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_with_its_place(tmp_path, test_file, text, said):
    before = {name: type(kind) for name, kind in catalogue().items()}
    if text is not None:
        (tmp_path / "my_laws.py").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"cannot be imported|no file|registers") as caught:
        load_test(test_file)
    assert said in caught.value.message
    assert "line " in caught.value.where
    assert "[effects] modules" in caught.value.where
    assert {name: type(kind) for name, kind in catalogue().items()} == before
    done = call("run", test_file, "-o", tmp_path / "out", "--json")
    assert done.exit_code == 1
    assert json.loads(done.stdout)["schema"] == "operando/error/1"


@pytest.mark.parametrize("modules", ['"my_laws.py"', "[1]", '[""]'])
def test_modules_are_a_list_of_files(tmp_path, modules):
    path = measurements.write_test(tmp_path, operating=False, check=False, extra=f"[effects]\nmodules = {modules}")
    with pytest.raises(ConfigError, match="a list of Python files"):
        load_test(path)


def test_two_files_cannot_share_a_name(tmp_path):
    with pytest.raises(ConfigError, match="there already"):
        load_effects([law(tmp_path), law(tmp_path, "other.py")])


def test_an_own_kind_is_added_to_results_where_its_file_is_named(tmp_path, out, monkeypatch):
    file = law(tmp_path, time=0)
    added = "strut_for_test@3+Z=stiffness:2e4"
    done = call("add", out, added)
    assert done.exit_code == 1
    assert "unknown kind of effect 'strut_for_test'" in done.stderr
    assert "named by --own FILE" in done.stderr
    with monkeypatch.context() as patch:  # the reports are asked for below
        patch.setattr("operando.report.write_report", lambda results, path: path.write_text(results.name, encoding="utf-8"))
        done = call("add", out, added, "--own", file, "--json")
    assert done.exit_code == 0, done.stderr
    effect = json.loads(done.stdout)["effects"][0]
    assert effect["kind"] == "strut_for_test"
    assert effect["parameters"]["stiffness"]["value"] == pytest.approx(3e4, rel=0.05)  # the spring of the running chain
    unregister("strut_for_test")
    shown = call("report", out)
    assert shown.exit_code == 0
    assert "unknown kind strut_for_test; name its file by --own FILE" in shown.stderr
    assert "unknown kind" not in call("report", out, "--own", file).stderr
    assert call("remove", out, "1", "--own", file).exit_code == 0


def test_an_error_in_a_law_of_ones_own_is_told_with_its_file_and_method(tmp_path, out):
    file = law(tmp_path, time=0)
    file.write_text(file.read_text().replace('values["stiffness"]', 'values["zzz"]'))
    done = call("add", out, "strut_for_test@3+Z=stiffness:2e4", "--own", file)
    assert done.exit_code == 1
    assert "dynamic_stiffness of strut_for_test, a kind of your own, failed: KeyError: 'zzz'" in done.stderr
    assert f"{file}, line " in done.stderr
    assert "fault of the program" not in done.stderr
    assert "values has stiffness" in done.stderr


def test_a_missing_diagnosis_names_the_test_file_that_makes_it(compared, out):
    done = call("diagnose", out)
    assert done.exit_code == 1
    assert f"`operando run {compared} -o {out} --until diagnose` makes it" in done.stderr


def test_the_list_has_all_kinds_with_parameters_units_and_locations():
    document = json.loads(call("effects", "--json").stdout)
    assert document["schema"] == "operando/effects/1"
    assert [k["kind"] for k in document["kinds"]] == list(catalogue())
    gap = next(k for k in document["kinds"] if k["kind"] == "clearance")
    assert [(p["name"], p["unit"]) for p in gap["parameters"]] == [("stiffness", "N/m"), ("gap", "m")]
    assert (gap["locations"], gap["level_dependent"], gap["own"]) == ([1, 2], True, False)
    text = call("effects").stdout
    assert all(name in text for name in catalogue())


@pytest.mark.parametrize("kind", catalogue())
def test_one_kind_has_a_law_and_an_example_that_add_takes(kind):
    from operando.structure.effects import parse_effect

    done = call("effects", kind)
    assert done.exit_code == 0, done.stderr
    assert "law: " in done.stdout
    example = done.stdout.split("operando add DIR ")[1].strip()
    assert parse_effect(example, (5.0, 145.0)).kind == kind


def test_own_kinds_are_listed_and_drawn(tmp_path, test_file):
    file = law(tmp_path)
    for named in (file, test_file):
        done = call("effects", "strut_for_test", "--own", named)
        assert done.exit_code == 0, done.stderr
        assert done.stdout.startswith("strut_for_test (own): a strut\nforce law: Z = k·(1 + s·T).")
        assert "|dynamic stiffness| [N/m]" in done.stdout
    done = call("effects", "--own", tmp_path / "none.py")
    assert done.exit_code == 1
    assert "--own: there is no file" in done.stderr


def test_the_picture_shows_the_play():
    rows = [line.split("|")[1] for line in call("effects", "clearance").stdout.splitlines() if "|" in line]
    assert rows[0].strip() == "**"
    assert "*" * 15 in rows[5]  # no force within the play


def own_model(method, gives, **attributes):
    """Two modes with an effect of an own kind, of which one method gives what is stated."""
    own = {"kind": "bad_for_test", "plain": "bad", "parameters": (Parameter("stiffness", "N/m", 1.0, 1e9, "log", 1e4),)}
    own["dynamic_stiffness"] = lambda self, s, values: values["stiffness"] * np.ones_like(s)
    kind = register(type("Bad", (EffectKind,), own | attributes | {method: lambda self, *given: gives(*given)}))
    idle = ModalModel([20.0, 45.0], [0.01, 0.02], [[1, 1], [1, -1]], "1+Z, 2+Z", "unit_modal_mass")
    return Model(idle, (Effect("bad_for_test", "1+Z" if kind.places else ()),))


@pytest.mark.parametrize(
    ("method", "attributes", "due"),
    [
        ("dynamic_stiffness", {}, "numbers of shape"),
        ("matrix", {}, "numbers of shape"),
        ("quadratic", {}, "a Quadratic of three"),
        ("sensor_map", {"acts": "sensor_map", "group": "sensor"}, "numbers of shape"),
        ("modal_change", {"acts": "modal_change", "places": 0}, "a ModalModel"),
        ("explain", {}, "a text"),
    ],
)
@pytest.mark.parametrize("wrong", [np.ones(7), b"abc", {}, [[1, 2], [3]], None])
def test_what_a_method_of_ones_own_returns_is_checked(method, attributes, due, wrong):
    if wrong is None and method == "quadratic":
        return  # there is no such form: allowed
    model = own_model(method, lambda *given: wrong, **attributes)
    with pytest.raises(ConfigError, match=f"{method} of bad_for_test, a kind of your own, returned .* expected {due}") as refused:
        model.modes() if method != "explain" else model.effects[0].explanation
    assert __file__ in refused.value.where


def test_one_number_is_the_same_at_every_frequency():
    constant, written_out = (
        own_model("dynamic_stiffness", gives) for gives in (lambda s, v: v["stiffness"], lambda s, v: v["stiffness"] + 0 * s)
    )
    assert np.array_equal(constant.modes().frequencies_hz, written_out.modes().frequencies_hz)
    assert np.array_equal(constant.frf([5.0, 30.0]).data, written_out.frf([5.0, 30.0]).data)


def test_a_force_has_the_shape_of_the_motion():
    model = own_model("pseudo_force", lambda x, v, values: x[:3], acts="pseudo_force", level_dependent=True)
    with pytest.raises(ConfigError, match=r"pseudo_force of bad_for_test, .*shape \(3,\), expected numbers of shape \(8,\)"):
        model.effects[0].definition.over_steps(np.ones(8), np.ones(8), {"stiffness": 1.0}, 0.1)


def test_modes_with_numbers_that_cannot_be_name_the_effect():
    with pytest.raises(IdentificationError, match=r"bad_for_test at 1.Z.*the modes cannot be computed"):
        own_model("dynamic_stiffness", lambda s, values: s * np.nan).modes()


def test_a_file_with_a_kind_that_is_not_registered_says_so_and_the_model_is_shown_all_the_same(tmp_path):
    model = own_model("dynamic_stiffness", lambda s, values: values["stiffness"], removable=True)
    removed = model.effects[0].with_values(stiffness=-5.0)
    model.save(tmp_path / "m.h5")
    kind = type(model.effects[0].definition)
    unregister("bad_for_test")
    assert "bad_for_test at 1+Z, stiffness 10000.0" in repr(model)
    assert model._repr_html_()
    assert str(removed) == "bad_for_test@1+Z=stiffness:5"
    with pytest.raises(FormatError, match=r"unknown kind of effect 'bad_for_test'.*import the module that registers it") as refused:
        load(tmp_path / "m.h5")
    assert "damaged" not in str(refused.value)
    register(kind)
    assert load(tmp_path / "m.h5").effects == model.effects
