"""A pytest plugin that records which test runs which line, and how long each test takes.

Loaded by ``python -m mutants record``. What a fixture of a module runs belongs to all tests of the file, not only to
the first that asks for it, so lines of a set-up are kept under the file's name. Each test file is written as soon as
its last test has run, so that a recording may be broken off; workers of pytest-xdist write the files they are given.
What a child process runs (drawing, windows, commands) is recorded too, by what coverage starts in any Python that finds
``COVERAGE_PROCESS_START``.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import re
import signal
from pathlib import Path

import coverage
import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("rbfmuscle", "pbd_baseline")


class TooSlow(BaseException):
    """A test took longer than the recording allows; not an Exception, which code under test may catch."""


class Recorder:
    """Follows the tests of one process.

    Parameters
    ----------
    folder : path
        Takes a JSON file for each test file.
    limit : float
        Seconds a test may take, 0 for any number; slower ones are left out.
    patience : int
        So many slow tests end the file.
    """

    def __init__(self, folder: Path, limit: float, patience: int) -> None:
        self.folder, self.limit, self.patience = folder, limit, patience
        self.seconds: dict[str, float] = {}
        self.bad: set[str] = set()
        self.slow: dict[str, int] = {}
        self.ended = ""
        self.coverage = coverage.Coverage(
            data_file=None, source=[str(ROOT / room) for room in ROOMS], config_file=False, messages=False
        )
        self.children = self.folder / "children" / os.environ.get("PYTEST_XDIST_WORKER", "alone")
        self.children.mkdir(parents=True, exist_ok=True)
        settings = self.children / "settings.ini"
        settings.write_text(
            "[run]\nparallel = true\npatch = _exit\n"
            f"data_file = {self.children / 'data'}\n"
            f"source =\n{''.join(f'    {ROOT / room}{chr(10)}' for room in ROOMS)}"
            "context = ${MUTANTS_TEST}\n",
            encoding="utf-8",
        )
        os.environ["COVERAGE_PROCESS_START"] = str(settings)
        self.coverage.start()

    def contexts_are(self, name):
        """What runs from now on belongs to a test, or to a file."""
        self.coverage.switch_context(name)
        os.environ["MUTANTS_TEST"] = name

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.seconds[item.nodeid] = 0.0
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item):
        file = _file_of(item)
        if self.limit and self.slow.get(file, 0) >= self.patience:
            pytest.skip("too many slow tests in this file")
        self.contexts_are(file)
        with self.timed(item), _Alarm(self.limit):
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        self.contexts_are(item.nodeid)
        with self.timed(item), _Alarm(self.limit):
            return (yield)

    @contextlib.contextmanager
    def timed(self, item):
        """Add up processor time, with that of children that have ended: others may load the machine."""
        began = os.times()[:4]
        try:
            yield
        finally:
            self.seconds[item.nodeid] += sum(os.times()[:4]) - sum(began)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item, nextitem):
        self.coverage.switch_context("")
        self.ended = _file_of(item) if nextitem is None or _file_of(nextitem) != _file_of(item) else ""
        return (yield)

    def pytest_runtest_logfinish(self, nodeid):
        if self.ended:
            self.coverage.stop()
            self.write(self.ended)
            self.coverage.start()
            self.ended = ""

    def pytest_runtest_logreport(self, report):
        if not report.passed:
            self.bad.add(report.nodeid)
        if report.failed and "TooSlow" in str(report.longrepr):
            file = report.nodeid.split("::")[0]
            self.slow[file] = self.slow.get(file, 0) + 1

    def write(self, file: str) -> None:
        """What the tests of one file ran."""
        data = self.coverage.get_data()
        data.set_query_contexts([f"^{re.escape(file)}(::|$)"])
        found: dict[str, dict[int, set[str]]] = {}
        for part in itertools.chain([data], self.of_children()):
            for name in part.measured_files():
                lines = found.setdefault(name, {})
                with contextlib.suppress(coverage.exceptions.DataError):  # a child that ended while it wrote
                    for line, contexts in part.contexts_by_lineno(name).items():
                        lines.setdefault(line, set()).update(c for c in contexts if c not in self.bad)
        files = {}
        for name, lines in found.items():
            lines = {line: sorted(tests) for line, tests in sorted(lines.items()) if tests}
            if lines:
                path = Path(name)
                files[str(path.relative_to(ROOT))] = {"digest": self.kept(path), "lines": lines}
        passed = {
            name: round(seconds, 3)
            for name, seconds in self.seconds.items()
            if name not in self.bad and name.split("::")[0] == file
        }
        self.folder.mkdir(parents=True, exist_ok=True)
        target = self.folder / (file.replace("/", "_") + ".json")
        target.write_text(json.dumps({"tests": passed, "files": files}), encoding="utf-8")

    def of_children(self):
        """What the child processes of this file's tests left."""
        for path in sorted(self.children.glob("data.*")):
            part = coverage.CoverageData(basename=str(path))
            with contextlib.suppress(coverage.exceptions.DataError):
                part.read()
                yield part
            path.unlink(missing_ok=True)

    def kept(self, path: Path) -> str:
        """Keep the text that was run, under a name of its own."""
        source = path.read_text(encoding="utf-8")
        digest = hashlib.sha256(source.encode()).hexdigest()
        copy = self.folder / "sources" / digest
        if not copy.exists():
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_text(source, encoding="utf-8")
        return digest


def _file_of(item):
    return item.nodeid.split("::")[0]


class _Alarm:
    def __init__(self, seconds):
        self.seconds = seconds

    def __enter__(self):
        if self.seconds:
            self.before = signal.signal(signal.SIGPROF, self._ring)
            signal.setitimer(signal.ITIMER_PROF, self.seconds)

    def __exit__(self, *caught):
        if self.seconds:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            signal.signal(signal.SIGPROF, self.before)
        if caught[0] is TooSlow:
            # Its own traceback may end at an instruction without a line, which pytest cannot show.
            raise pytest.fail.Exception("TooSlow", pytrace=False) from None

    @staticmethod
    def _ring(number, frame):
        if frame is not None and "coverage" in Path(frame.f_code.co_filename).parts:
            # It may hold its lock, which would then never be given back: a little later will do.
            signal.setitimer(signal.ITIMER_PROF, 0.01)
            return
        raise TooSlow


def pytest_configure(config):
    """Start to follow."""
    folder = os.environ.get("MUTANTS_RECORD")
    leads_workers = bool(config.getoption("numprocesses", None)) and "PYTEST_XDIST_WORKER" not in os.environ
    if folder and not leads_workers:
        limit, patience = (
            float(os.environ.get("MUTANTS_LIMIT", "0")),
            int(os.environ.get("MUTANTS_PATIENCE", "8")),
        )
        config.pluginmanager.register(Recorder(Path(folder), limit, patience), "mutants-recorder")
