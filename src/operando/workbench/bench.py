"""What the pages of the workbench share: a results folder, the test file with its changes, the work in the background."""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from operando.config import text_of
from operando.errors import BusyError, ConfigError, MissingError, OperandoError
from operando.paths import example_folder, path_of
from operando.pipeline.folder import default_folder, source_of
from operando.results import Results
from operando.store import load_results
from operando.values import nearest
from operando.workbench.edits import Draft, Exclude, SetValue
from operando.workbench.job import Job
from operando.workbench.view import channels


class Bench:
    """The state of one workbench.

    Parameters
    ----------
    source : path
        A results folder, a test file, or a folder that holds ``test.toml``.
    output : path, optional
        Results folder of a test file; default ``results/NAME`` here.
    changes : sequence of str
        Entries that take the place of those in the test file.

    Attributes
    ----------
    folder : Path
        The results folder.
    draft : Draft or None
        The test file; None where it is not known or must not be written.
    why_not : str
        Why there is none.
    unread : str
        Why the results cannot be read.
    test_path : Path or None
        The test file that is run; None where it is not known.
    job : Job or None
        The last work in the background.
    """

    def __init__(self, source: str | Path, output: str | Path | None = None, changes: Sequence[str] = ()) -> None:
        path = Path(source)
        self.lock, self.changes = threading.RLock(), tuple(changes)
        self.draft: Draft | None = None
        self.why_not = self.unread = ""
        self.test_path: Path | None = None
        self.job: Job | None = None
        self._loaded: tuple[Any, Results | None] = (None, None)
        if path.is_dir() and (path / "model.h5").exists():
            if output is not None:
                raise ConfigError("-o belongs to a test file", where=str(path), hint="leave it out: this is a results folder already")
            self.folder = path.resolve()
            self._find_test()
        else:
            self._open(path / "test.toml" if path.is_dir() else path)
            assert self.draft is not None
            name = self.draft.test.name
            self.folder = (path_of(output, "results go into a folder") if output is not None else default_folder(name)).resolve()
            self._refuse_example()

    def _open(self, path: Path) -> None:
        self.draft = Draft(path.resolve(), self.changes)
        self.test_path = self.draft.path

    def _find_test(self) -> None:
        """The test file of a results folder; one that imports Python files is not read unless the user names it."""
        found = source_of(self.folder)
        if found is None:
            self.why_not = "The results do not name their test file, or it has gone. Start with the test file: operando workbench test.toml"
            return
        try:
            imports = bool(tomllib.loads(text_of(found)).get("effects"))
            if not imports:
                self._open(found)
                self._refuse_example()
        except (OperandoError, ValueError) as error:
            self.why_not = f"The test file {found} cannot be read: {error}"
            return
        if imports:
            self.why_not = f"The test file {found} imports Python files ([effects]). Name it to allow that: operando workbench {found}"

    def _refuse_example(self) -> None:
        try:
            packaged = example_folder().resolve()
        except MissingError:
            return
        if self.draft is not None and self.draft.path.is_relative_to(packaged):
            self.draft = None
            self.why_not = f"The packaged example is not changed. Copy {packaged} and run the copy to change its test file."

    @property
    def results(self) -> Results | None:
        """The results now; None where there are none yet."""
        model = self.folder / "model.h5"
        with self.lock:
            try:
                state = model.stat()
                stamp = (state.st_mtime_ns, state.st_size, state.st_ino)
                if stamp != self._loaded[0]:
                    self._loaded = (stamp, load_results(self.folder))
                self.unread = ""
            except (OSError, OperandoError) as error:
                if not self.busy:  # while a run puts new files in the place of old ones, the old results stay on the page
                    self._loaded = (None, None)
                    self.unread = str(error) if isinstance(error, OperandoError) else ""
            return self._loaded[1]

    def look(self) -> None:
        """Take the test file as it is now, where no changes wait."""
        if self.draft is not None and not self.draft.edits and self.draft.changed_on_disk():
            with suppress(OperandoError):  # the page says that it was changed, and reading it again says what is wrong with it
                self.draft.read_again()

    @property
    def busy(self) -> bool:
        """Whether work is under way."""
        return self.job is not None and not self.job.over

    def state(self) -> dict[str, Any] | None:
        """Of the last work in the background; None where there was none."""
        return None if self.job is None else self.job.state()

    def writable(self) -> Draft:
        """The test file."""
        if self.draft is None:
            raise MissingError("the test file cannot be changed here", where=str(self.folder), hint=self.why_not)
        return self.draft

    def not_run(self) -> list[str]:
        """Settings of the test file, as saved, that differ from those the results shown were made with."""
        results = self.results
        if results is None or self.draft is None:
            return []
        return [key for key, value in self.draft.test.settings().items() if results.settings.get(key) != value]

    def mode(self, do: str, state: str, hz: float) -> str:
        """Take a pole as a mode, or leave a mode out; what was done, in words. See :func:`operando.workbench.modes.take`."""
        from operando.workbench.modes import leave, take

        draft, results = self.writable(), self.results
        if results is None:
            raise MissingError("there are no results yet", where=str(self.folder), hint="run the test")
        edit, words = (take if do == "take" else leave)(results, draft.table.get("analysis", {}), state, hz)
        draft.add(edit)
        return words

    def exclude(self, channel: str, reason: str) -> None:
        """Leave a channel out."""
        if not reason.strip():
            raise ConfigError("no reason is given", where=f"channel {channel}", hint="write in a few words why it is left out")
        draft, results = self.writable(), self.results
        known = [] if results is None else [row["key"] for row in channels(results, draft.table)["rows"]]
        if known and channel not in known:
            raise ConfigError(f"the test has no channel {channel!r:.60}", hint=nearest(channel, known))
        draft.add(Exclude(channel, reason.strip()))

    def include(self, channel: str) -> None:
        """Take a channel back."""
        self.writable().add(Exclude(channel, None))

    def bands(self, band: list[Any] | None, excluded: list[list[float]]) -> None:
        """Another band of the analysis, and bands that nothing uses [Hz]; only what differs is changed."""
        table = self.writable().table.get("analysis", {})
        for key, value in (("band", band), ("exclude_bands", excluded or None)):
            if table.get(key) != value:
                self.writable().add(SetValue(key, value))

    def _idle(self) -> None:
        if self.busy:
            raise BusyError("work is under way", where=str(self.folder), hint="wait for its end, or stop it")

    def start(self, **task: Any) -> None:
        """Begin work in the background.

        Raises
        ------
        BusyError
            If other work is under way here. Work of other processes is noticed by the work itself.
        """
        with self.lock:
            self._idle()
            self.job = Job(
                {
                    "folder": str(self.folder),
                    "test": None if self.test_path is None else str(self.test_path),
                    "changes": self.changes,
                    **task,
                }
            )

    def save_and_run(self) -> None:
        """Write the changes into the test file and run the test again."""
        with self.lock:
            self._idle()
            if self.test_path is None:
                self.writable()  # says why
            if self.draft is not None:
                self.draft.save()
            self.start(do="run")

    def stop(self) -> None:
        """Stop the work."""
        if self.job is not None:
            self.job.stop()
            self.job.wait(10)
