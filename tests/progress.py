"""Tell, while tests run, which file begins, how long it took, and where a test hangs that gives no result for a minute."""

import threading
import time
from collections import Counter
from pathlib import PurePath

import pytest

PATIENCE = 60  # without any result [s]


@pytest.hookimpl(trylast=True)  # when the terminal is there
def pytest_configure(config):
    """Say where the tests are, in the process that starts the others."""
    terminal = config.pluginmanager.get_plugin("terminalreporter")
    if terminal is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Progress(terminal, config.pluginmanager.get_plugin("capturemanager")))


class Progress:
    """One line when the tests of a file begin, one when the last of them has ended, in place of a dot for each test."""

    def __init__(self, terminal, capture):
        self._terminal, self._capture, self._lock, self._over = terminal, capture, threading.Lock(), threading.Event()
        self._left: Counter[str] = Counter()  # tests of each file that have not ended
        self._results: dict[str, Counter[str]] = {}  # of each file that has begun: how many passed, failed, ...
        self._began: dict[str, float] = {}  # files, and tests that run
        self._last = time.monotonic()
        threading.Thread(target=self._watch, daemon=True).start()

    def pytest_collection_finish(self, session):
        self._expect(item.nodeid for item in session.items)

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids):
        self._expect(ids)  # each process collects the same

    def _expect(self, ids):
        self._left = Counter(map(_file_of, ids)) or self._left

    def pytest_runtest_logstart(self, nodeid):
        file = _file_of(nodeid)
        with self._lock:
            self._began[nodeid] = self._last = time.monotonic()
            if file in self._results:
                return
            self._began[file], self._results[file] = self._last, Counter()
        self._say(f"       {file}: {self._left[file]} tests begin")

    def pytest_runtest_logreport(self, report):
        kind = "error" if report.failed and report.when != "call" else report.outcome
        if report.when == "call" or not report.passed:
            self._results[_file_of(report.nodeid)][kind] += 1

    def pytest_runtest_logfinish(self, nodeid):
        file = _file_of(nodeid)
        with self._lock:
            self._last = time.monotonic()
            self._began.pop(nodeid, None)
            self._left[file] -= 1
            if self._left[file]:
                return
            took, left = self._last - self._began.pop(file), self._left.total()
        part = 100 * (1 - left / max(1, left + sum(each.total() for each in self._results.values())))
        found = ", ".join(f"{number} {kind}" for kind, number in sorted(self._results[file].items()))
        self._say(f"[{part:3.0f}%] {file}: {found} in {took:.1f} s")

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(self, report):
        """Give a test that passed no letter of its own; all others are told as pytest tells them."""
        return ("passed" if report.when == "call" else "", "", "PASSED") if report.passed else None

    def pytest_unconfigure(self):
        self._over.set()

    def _watch(self):
        told = 0.0
        while not self._over.wait(1):
            with self._lock:
                quiet = time.monotonic() - max(self._last, told)
                running = [name for name in self._began if "::" in name]
            if quiet > PATIENCE and running:
                told = time.monotonic()
                with self._capture.global_and_fixture_disabled():  # of a test that runs in this process
                    self._say(f"       no result for {told - self._last:.0f} s: {', '.join(running)} runs")

    def _say(self, line):
        with self._lock:
            self._terminal.ensure_newline()
            self._terminal.write_line(line)


def _file_of(nodeid):
    return PurePath(nodeid.partition("::")[0]).as_posix()
