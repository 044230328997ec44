"""The pages of the workbench over HTTP, for one user of this machine: nothing is answered without the token of this start."""

from __future__ import annotations

import hmac
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from operando.dof import check_dofs
from operando.errors import ConfigError, MissingError, OperandoError
from operando.results import Results
from operando.structure.effects import parse_effect
from operando.workbench import modes, view
from operando.workbench.bench import Bench

if TYPE_CHECKING:
    from flask import Flask, Response

POLICY = "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads allow-popups; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
"""The report has its style and script inside; its own, stricter rule holds besides."""
MOST_BYTES = 65536
TABS = (
    ("modes/idle", "Idle modes"),
    ("modes/operating", "Operational modes"),
    ("missing", "What is missing"),
    ("data", "Data"),
    ("report", "Report"),
)


def make_app(bench: Bench, token: str) -> Flask:
    """The application of Flask; ``app.config["PORT"]`` must be set before the first request.

    The address at the start holds ``token``; every request brings it as a cookie, those that change something in a header.
    """
    from flask import Flask, Response, abort, request
    from werkzeug.exceptions import HTTPException

    app = Flask("operando.workbench", static_folder=None)
    app.json.sort_keys = False  # type: ignore[attr-defined]
    app.config["MAX_CONTENT_LENGTH"] = MOST_BYTES

    def cookie() -> str:
        return f"operando-{app.config['PORT']}"

    @app.before_request
    def guard() -> None:
        hosts = [f"{name}:{app.config['PORT']}" for name in ("127.0.0.1", "localhost")]
        if request.host not in hosts or request.headers.get("Origin", f"http://{request.host}") != f"http://{request.host}":
            abort(403, "This address is not answered.")
        given = request.headers.get("X-Operando-Token", "")
        if request.method == "GET":
            given = request.args.get("token", "") if request.path == "/" else request.cookies.get(cookie(), "")
        if not hmac.compare_digest(given.encode(), token.encode()):
            abort(403, "Open the address that `operando workbench` printed: it holds the token of this start.")

    @app.after_request
    def headers(response: Response) -> Response:
        response.headers.setdefault("Content-Security-Policy", POLICY)
        for name, value in (("X-Content-Type-Options", "nosniff"), ("Referrer-Policy", "no-referrer"), ("Cache-Control", "no-store")):
            response.headers[name] = value
        return response

    @app.errorhandler(OperandoError)
    def explained(error: OperandoError) -> tuple[Any, int]:
        if request.method == "GET":
            return page("failed.html.j2", "", error=error), 500
        return error.to_dict(), 400

    @app.errorhandler(HTTPException)
    def refused(error: HTTPException) -> Any:
        """What is asked for by a program is answered in JSON, a fault of this one included."""
        if request.method == "GET":
            return error
        cause = getattr(error, "original_exception", None)
        if cause is None:
            return OperandoError(error.description or error.name, where=request.path).to_dict(), error.code
        text = f"unexpected {type(cause).__name__}: {cause}"
        return OperandoError(text, where="operando itself", hint="a fault of the program, not of your data").to_dict(), 500

    def page(template: str, tab: str, **values: Any) -> str:
        results = bench.results
        title = results.name if results is not None else bench.draft.test.name if bench.draft is not None else bench.folder.name
        return view.render(
            template, tabs=TABS, tab=tab, title=title, folder=str(bench.folder), token=token, results=results, panel=panel(), **values
        )

    def panel() -> Any:
        bench.look()
        draft = bench.draft
        return view.render(
            "panel.html.j2", job=bench.state(), busy=bench.busy, why_not=bench.why_not, writable=draft is not None,
            can_run=bench.test_path is not None, test="" if draft is None else str(draft.path),
            lines=[] if draft is None else draft.lines(),
            edits=0 if draft is None else len(draft.edits), not_run=bench.not_run(), new=bench.results is None,
            unread=bench.unread, changes=bench.changes,
            changed=draft is not None and draft.changed_on_disk(),
        )  # fmt: skip

    @app.get("/")
    def start() -> Response:
        made = Response(view.render("start.html.j2"), mimetype="text/html")
        made.set_cookie(cookie(), token, httponly=True, samesite="Strict")
        return made

    @app.get("/modes/<any(idle,operating):state>")
    def modes_page(state: str) -> str:
        results, rows, poles, why = bench.results, [], [], ""
        if results is not None:
            try:
                rows, poles = modes.marked(results, analysis(), state), modes.candidates(results, analysis(), state)
            except MissingError as error:
                why = str(error)
        return page("modes.html.j2", f"modes/{state}", state=state, rows=rows, poles=poles, why=why)

    @app.get("/diagram/<any(idle,operating):state>")
    def diagram(state: str) -> Any:
        results = bench.results
        try:
            return modes.diagram(results, analysis(), state) if results is not None else ({}, 404)
        except MissingError as error:
            return error.to_dict(), 404

    @app.get("/missing")
    def missing_page() -> str:
        results = bench.results
        return page("effects.html.j2", "missing", found=None if results is None else view.effects(results))

    @app.get("/data")
    def data_page() -> str:
        results = bench.results
        table = bench.draft.table if bench.draft is not None else {} if results is None else settings_table(results.settings)
        return page("channels.html.j2", "data", found=view.channels(results or Results(""), table), writable=bench.draft is not None)

    @app.get("/report")
    def report_page() -> str:
        return page("report_page.html.j2", "report", there=(bench.folder / "report.html").is_file())

    @app.get("/report.html")
    def report() -> Response:
        try:
            text = (bench.folder / "report.html").read_bytes()
        except OSError:
            abort(404)
        return Response(text, mimetype="text/html", headers={"Content-Security-Policy": REPORT_POLICY})

    @app.get("/panel")
    def panel_only() -> Any:
        return panel()

    @app.get("/<any('workbench.css','workbench.js','icon.svg','report.css'):name>")
    def asset(name: str) -> Response:
        package = files("operando.report") / "templates" if name == "report.css" else files("operando.workbench") / "static"
        kind = {"css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}[name.rpartition(".")[2]]
        return Response((package / name).read_bytes(), mimetype=kind)

    def analysis() -> dict[str, Any]:
        results = bench.results
        if bench.draft is not None:
            return dict(bench.draft.table.get("analysis", {}))
        return {} if results is None else dict(results.settings)

    @app.post("/do/<what>")
    def do(what: str) -> dict[str, Any]:
        try:
            given = request.get_json(force=True, silent=True)
        except RecursionError:  # lists in lists without end
            given = None
        if not isinstance(given, dict):
            abort(400, "The request holds no JSON object.")
        with bench.lock:
            return {"said": perform(bench, what, given)}

    return app


def settings_table(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of results in the form of a test file."""
    return {"analysis": {k: v for k, v in settings.items() if v is not None}, "channels": settings.get("channels") or {}}


def perform(bench: Bench, what: str, given: dict[str, Any]) -> str:
    """Do what a page asks for; what was done, in words."""
    if what in ("take", "leave"):
        return bench.mode(what, _state(given), _number(given, "hz"))
    if what == "exclude":
        bench.exclude(_text(given, "channel"), _text(given, "reason"))
    elif what == "include":
        bench.include(_text(given, "channel"))
    elif what == "bands":
        band, excluded = [given.get("low"), given.get("high")], given.get("excluded") or []
        for pair in (band, *excluded) if isinstance(excluded, list) else (None,):
            if not isinstance(pair, list) or (None in pair and pair != [None, None]):
                raise ConfigError("a band needs both its limits", where=f"{pair!r:.60}", hint="fill in both fields, or leave both empty")
        bench.bands(None if band == [None, None] else band, excluded)
    elif what == "undo":
        bench.writable().undo()
    elif what == "discard":
        bench.writable().edits.clear()
    elif what == "reread":
        gone = bench.writable().read_again()
        return "The test file was read again." + (f" Changes that do not fit it any more: {'; '.join(gone)}" if gone else "")
    elif what == "save":
        bench.writable().save()
        return "The test file was written."
    elif what == "run":
        bench.save_and_run()
    elif what == "stop":
        bench.stop()
    elif what == "add":
        text = _effect(given)
        results = bench.results
        if results is not None and results.idle is not None:  # wrong names are said at once
            check_dofs(parse_effect(text, results.idle.band_hz).location, results.idle.dofs, f"effect {text!r:.200}")
        bench.start(do="add", effects=[text], fix=given.get("fix") is True)
    elif what == "candidate":
        bench.start(do="candidate", number=_whole(given, "number"))
    elif what == "suggested":
        bench.start(do="suggested")
    elif what == "remove":
        bench.start(do="remove", step=_whole(given, "step"))
    else:
        raise ConfigError(f"there is no action {what!r:.50}")
    return ""


def _effect(given: dict[str, Any]) -> str:
    """The effect of the form as ``operando add`` takes it."""
    asked, values = given.get("dofs") or [], given.get("values") or {}
    if not isinstance(asked, list) or not isinstance(values, dict) or not all(isinstance(text, str) for text in (*asked, *values.values())):
        raise ConfigError("dofs is no list of texts, or values no table of texts")
    dofs = [d.strip() for d in asked if d.strip()]
    items = [f"{name}:{value.strip()}" for name, value in values.items() if value.strip()]
    return _text(given, "kind") + ("@" + ",".join(dofs) if dofs else "") + ("=" + ",".join(items) if items else "")


def _state(given: dict[str, Any]) -> str:
    state = given.get("state")
    if not isinstance(state, str) or state not in modes.STATES:
        raise ConfigError("no state is given", hint="idle or operating")
    return state


def _number(given: dict[str, Any], key: str) -> float:
    value = given.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e12:
        raise ConfigError(f"{key} is no number")
    return float(value)


def _whole(given: dict[str, Any], key: str) -> int:
    value = _number(given, key)
    if value != int(value):
        raise ConfigError(f"{key} is no whole number")
    return int(value)


def _text(given: dict[str, Any], key: str) -> str:
    value = given.get(key)
    if value == "":
        raise ConfigError(f"{key} is empty")
    if not isinstance(value, str) or len(value) > 500 or any("\ud800" <= c <= "\udfff" for c in value):  # no file holds these
        raise ConfigError(f"{key} is no text")
    return value
