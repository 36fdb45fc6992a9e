"""A pytest plugin that records which test runs which line, and how long each test takes.

Loaded by ``python -m mutants record``. What a fixture of a module runs belongs to all tests of the file, not only to
the first that asks for it, so lines of a set-up are kept under the file's name.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import time
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
    output : path
        JSON file to write at the end.
    limit : float
        Seconds a test may take, 0 for any number; slower ones are left out.
    patience : int
        So many slow tests end the file.
    """

    def __init__(self, output: Path, limit: float, patience: int) -> None:
        self.output, self.limit, self.patience = output, limit, patience
        self.seconds: dict[str, float] = {}
        self.bad: set[str] = set()
        self.slow: dict[str, int] = {}
        self.coverage = coverage.Coverage(
            data_file=None, source=[str(ROOT / room) for room in ROOMS], config_file=False, messages=False
        )
        self.coverage.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.seconds[item.nodeid] = 0.0
        self.began = time.perf_counter()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item):
        file = item.nodeid.split("::")[0]
        if self.limit and self.slow.get(file, 0) >= self.patience:
            pytest.skip("too many slow tests in this file")
        self.coverage.switch_context(file)
        with _Alarm(self.limit):
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        self.coverage.switch_context(item.nodeid)
        with _Alarm(self.limit):
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item):
        self.coverage.switch_context("")
        return (yield)

    def pytest_runtest_logreport(self, report):
        if report.when != "teardown":
            self.seconds[report.nodeid] += report.duration
        if not report.passed:
            self.bad.add(report.nodeid)
        if report.failed and "TooSlow" in str(report.longrepr):
            file = report.nodeid.split("::")[0]
            self.slow[file] = self.slow.get(file, 0) + 1

    def pytest_sessionfinish(self, session):
        self.coverage.stop()
        data = self.coverage.get_data()
        files = {}
        for name in data.measured_files():
            path = Path(name)
            source = path.read_text(encoding="utf-8")
            digest = hashlib.sha256(source.encode()).hexdigest()
            kept = self.output.parent / "sources" / digest
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(source, encoding="utf-8")
            lines = {
                line: sorted(c for c in contexts if c not in self.bad and c)
                for line, contexts in data.contexts_by_lineno(name).items()
            }
            files[str(path.relative_to(ROOT))] = {
                "digest": digest,
                "lines": {line: tests for line, tests in lines.items() if tests},
            }
        tests = {name: round(seconds, 3) for name, seconds in self.seconds.items() if name not in self.bad}
        self.output.parent.mkdir(parents=True, exist_ok=True)
        self.output.write_text(json.dumps({"tests": tests, "files": files}), encoding="utf-8")


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

    @staticmethod
    def _ring(number, frame):
        raise TooSlow


def pytest_configure(config):
    """Start to follow."""
    output = os.environ.get("MUTANTS_RECORD")
    if output:
        limit, patience = (
            float(os.environ.get("MUTANTS_LIMIT", "0")),
            int(os.environ.get("MUTANTS_PATIENCE", "8")),
        )
        config.pluginmanager.register(Recorder(Path(output), limit, patience), "mutants-recorder")
