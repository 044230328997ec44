"""The catalogue of findings: every finding that the code can report, with its words, read from the source."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import operando
from operando.frf.hits import FINDING_KINDS

SOURCE = Path(operando.__file__).resolve().parent
MAKERS = {"Finding": 0, "_finding": 2, "note": 0}
"""Calls that make a finding, and which of their arguments is the kind."""
FILLED = "…"
GROUPS = (
    ("Files and channels", "io pipeline quality/between", "Found while files are read and states are put together."),
    ("Raw records", "quality", "Found in the samples of each record."),
    ("FRF estimation", "frf", "Found in hits, runs and FRFs."),
    ("EMA", "ema", "Found by the modal analysis of the idle FRFs."),
    ("OMA", "oma", "Found by the modal analysis of operating records."),
    (
        "Scaling and comparison",
        "scaling compare diagnose nonlinear diagnosis structure",
        "Found where the idle and the operating state are put together.",
    ),
)


@dataclass(frozen=True)
class Said:
    """One place in the code that makes a finding; "…" stands for names and numbers."""

    kind: str
    severity: str
    message: str
    consequence: str
    action: str
    room: str


class _Scope:
    """Texts that the names of a function or module stand for."""

    def __init__(self, tree: ast.AST) -> None:
        self.texts: dict[str, list[ast.expr]] = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.Assign):
                for target in node.targets:
                    self._take(target, node.value)
            elif isinstance(node, ast.AnnAssign) and node.value is not None:
                self._take(node.target, node.value)
            elif isinstance(node, ast.For) and isinstance(node.target, ast.Tuple) and ast.unparse(node.iter).endswith(".items()"):
                self._take(node.target.elts[0], node.iter.func.value)  # type: ignore[attr-defined]  # the keys of a table

    def before(self, name: str, line: int) -> ast.expr | None:
        """What a name was last given above a line."""
        above = [value for value in self.texts.get(name, []) if value.lineno <= line]
        return max(above, key=lambda value: value.lineno, default=None)

    def _take(self, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Name):
            self.texts.setdefault(target.id, []).append(value)
        elif isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            for one, its in zip(target.elts, value.elts, strict=False):
                self._take(one, its)


def _text(node: ast.expr | None, scopes: tuple[_Scope, ...], depth: int = 3) -> str:
    """The text of an expression, with "…" for what is only known when it runs."""
    if node is None:
        return ""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(v, scopes, 0) if isinstance(v, ast.Constant) else FILLED for v in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text(node.left, scopes, depth) + _text(node.right, scopes, depth)
    if isinstance(node, ast.IfExp):
        parts = [t for t in (_text(node.body, scopes, depth), _text(node.orelse, scopes, depth)) if t and t != FILLED]
        return " / ".join(dict.fromkeys(parts)) or FILLED
    if isinstance(node, ast.BoolOp):
        return " / ".join(t for t in (_text(v, scopes, depth) for v in node.values) if t and t != FILLED) or FILLED
    if isinstance(node, ast.Name) and depth:
        for scope in scopes:
            if (value := scope.before(node.id, node.lineno)) is not None:
                return _text(value, scopes, depth - 1)
    return FILLED


def _calls(tree: ast.Module) -> Iterator[tuple[ast.Call, tuple[_Scope, ...]]]:
    """Every call with the texts of its function and of its module."""
    whole = _Scope(tree)
    inside: dict[ast.Call, _Scope] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            scope = _Scope(node)
            inside |= {call: scope for call in ast.walk(node) if isinstance(call, ast.Call)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield node, ((inside[node], whole) if node in inside else (whole,))


def said() -> list[Said]:
    """All findings of the source, in the order of rooms and lines."""
    out = []
    for path in sorted(SOURCE.rglob("*.py")):
        room = path.relative_to(SOURCE).with_suffix("").as_posix()
        for call, scopes in _calls(ast.parse(path.read_text(encoding="utf-8"))):
            maker = ast.unparse(call.func).split(".")[-1]
            if maker not in MAKERS or (maker == "note" and not room.startswith("io")):
                continue
            named = {k.arg: k.value for k in call.keywords if k.arg}
            at = MAKERS[maker]
            kinds = _kinds(call.args[at] if len(call.args) > at else named.get("kind"), scopes)
            message = _text(call.args[at + 1] if len(call.args) > at + 1 else named.get("message"), scopes)
            if maker == "_finding":
                consequence, action, _, severity = (_text(a, scopes) for a in (*call.args[4:8], *[None] * 4)[:4])
                severity = severity or _text(named.get("severity"), scopes) or "warning"
            else:
                given = call.args[2] if maker == "Finding" and len(call.args) > 2 else named.get("severity")
                severity = _text(given, scopes) or "warning"
                consequence, action = _text(named.get("consequence"), scopes), _text(named.get("action"), scopes)
            out += [Said(kind, severity, message, consequence, action, room) for kind in kinds]
    return out


def _kinds(node: ast.expr | None, scopes: tuple[_Scope, ...], depth: int = 3) -> list[str]:
    """Kinds that an argument may be: a text, one of two, the keys of a table, or what a name stands for."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [node.value]
    if isinstance(node, ast.IfExp):
        return _kinds(node.body, scopes, depth) + _kinds(node.orelse, scopes, depth)
    if isinstance(node, ast.Dict):
        return [kind for key in node.keys for kind in _kinds(key, scopes, depth)]
    if isinstance(node, ast.Name) and node.id == "reason":  # of a hit
        return list(FINDING_KINDS)
    if isinstance(node, ast.Name) and depth:
        for scope in scopes:
            if (value := scope.before(node.id, node.lineno)) is not None:
                return _kinds(value, scopes, depth - 1)
    return []


def _group(room: str) -> int:
    for number in (0, 2, 3, 4, 5, 1):
        if any(room == name or room.startswith(name + "/") for name in GROUPS[number][1].split()):
            return number
    return 0


def _cell(text: str) -> str:
    while FILLED + FILLED in text or FILLED + " " + FILLED in text:
        text = text.replace(FILLED + FILLED, FILLED).replace(FILLED + " " + FILLED, FILLED)
    text = text.strip()
    text = "–" if text in ("", FILLED) else text
    return text.replace("\\", r"\\").replace("|", r"\|").replace("*", r"\*").replace("<", "&lt;")


def page() -> str:
    """The page without its title."""
    out = []
    found = said()
    for number, (title, _, words) in enumerate(GROUPS):
        mine = [s for s in found if _group(s.room) == number]
        if not mine:
            continue
        out += [f"## {title}", "", words, ""]
        for kind in sorted({s.kind for s in mine}):
            out += [f"### `{kind}`", ""]
            for s in dict.fromkeys(s for s in mine if s.kind == kind):
                what = [f"**{s.severity}**: {_cell(s.message)}"] if _cell(s.message) != "–" else [f"**{s.severity}**"]
                if _cell(s.consequence) != "–":
                    what.append(f"*Consequence:* {_cell(s.consequence)}")
                if _cell(s.action) != "–":
                    what.append(f"*What to do:* {_cell(s.action)}")
                out.append("- " + "  \n  ".join(what))
            out.append("")
    return "\n".join(out)
