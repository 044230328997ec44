"""DOFs of components: ``FRAM:1+Z`` and ``MOTR:1+Z`` are two places, from the label to the results."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from measurements import idle_chain, record
from operando.data import Geometry
from operando.dof import Dof, match_dofs, node_label, parse_dofs, split_node
from operando.errors import DofError
from operando.io import read, write_csv, write_uff


@pytest.mark.parametrize(
    ("text", "printed", "component", "number"),
    [
        ("FRAM:1+Z", "FRAM:1+Z", "FRAM", 1),
        ("FRAM:1:+Z", "FRAM:1+Z", "FRAM", 1),
        ("FRAM:1Z", "FRAM:1+Z", "FRAM", 1),
        (" wing left:12-RX ", "wing left:12-RX", "wing left", 12),
        ("WING-L:007+X", "WING-L:7+X", "WING-L", 7),
        ("MOTR:3", "MOTR:3", "MOTR", 3),
        ("hub:5+beam1", "hub:5+beam1", "hub", 5),
        ("12+Z", "12+Z", "", 12),
    ],
)
def test_labels(text, printed, component, number):
    dof = Dof.parse(text)
    assert (str(dof), dof.component, dof.number) == (printed, component, number)
    assert Dof.parse(str(dof)) == dof == pickle.loads(pickle.dumps(dof))
    assert split_node(dof.node) == (component, number)
    assert node_label(component, number) == dof.node


@pytest.mark.parametrize(
    "text", ["FRAM:+Z", ":1+Z", "a,b:1+Z", "a:1:2+Z", "a/b:1+Z", "x\x1b[2J:1+Z", "A" * 40 + ":1+Z", "9" * 100_000, "a:" + "9" * 40]
)
def test_what_is_no_label(text):
    with pytest.raises(DofError) as error:
        Dof.parse(text)
    assert len(str(error.value)) < 300


def test_components_tell_dofs_apart_and_sort_them():
    dofs = parse_dofs("FRAM:10+Z,MOTR:1+Z,3+Z,FRAM:1+Z,FRAM:2+Z")
    assert [str(d) for d in sorted(dofs)] == ["3+Z", "FRAM:1+Z", "FRAM:2+Z", "FRAM:10+Z", "MOTR:1+Z"]
    assert len({(d.node, d.axis) for d in dofs}) == 5
    assert not Dof.parse("FRAM:1+Z").same_axis(Dof.parse("MOTR:1+Z"))
    assert match_dofs(parse_dofs("FRAM:1-Z"), dofs) == ([3], [-1])
    with pytest.raises(DofError, match="MOTR:2"):
        match_dofs(parse_dofs("MOTR:2+Z"), dofs)


def test_from_record_to_frf(tmp_path):
    import operando
    from operando.config import State, Test
    from operando.pipeline.inputs import Inputs

    run = record(idle_chain(), [0], 20.0, 3, "run")
    labels = {1: "FRAM:1", 2: "FRAM:2", 3: "MOTR:1", 4: "MOTR:2"}
    channels = tuple(c if c.dof is None else replace(c, dof=Dof(labels[c.dof.node], c.dof.axis, c.dof.sign), name="") for c in run.channels)
    write_uff(tmp_path / "run.uff", replace(run, channels=channels))
    write_uff(tmp_path / "geometry.uff", Geometry((1, 2, 5), np.eye(3)))
    inputs = Inputs(Test("t", idle=State(records=(tmp_path / "run.uff",)), geometry_file=tmp_path / "geometry.uff"))
    (back,) = inputs.records(inputs.test.idle, force=True)
    assert [c.label for c in back.channels] == [str(c.dof) for c in channels]
    frf = operando.estimate_frf([back], block_seconds=4.0)
    assert {str(d) for d in frf.responses} == {"FRAM:1+Z", "FRAM:2+Z", "MOTR:1+Z", "MOTR:2+Z"}
    assert [str(d) for d in frf.references] == ["FRAM:1+Z"]
    plain = operando.estimate_frf([run], block_seconds=4.0)
    for number, label in labels.items():
        np.testing.assert_allclose(frf.select([f"{label}+Z"]).data, plain.select([f"{number}+Z"]).data, rtol=1e-10)
    geometry = inputs.geometry()
    assert geometry.nodes == (1, 2, 5)  # node 1 may be FRAM:1 or MOTR:1
    (finding,) = [f for found in inputs.findings.values() for f in found if f.kind == "unclear_component"]
    assert "nodes 1, 2 " in finding.message


def test_a_table_keeps_components(tmp_path):
    run = record(idle_chain(), [0], 2.0, 3, "run")
    channels = tuple(c if c.dof is None else replace(c, dof=Dof(f"FRAM:{c.dof.node}", c.dof.axis), name="") for c in run.channels)
    write_csv(tmp_path / "a.csv", replace(run, channels=channels))
    assert [c.label for c in read(tmp_path / "a.csv").records[0].channels] == [c.label for c in channels]
