"""Every public name has an example that runs and gives what it shows; so have the rooms' own
functions.
"""

import doctest
import importlib
import inspect
import sys
import warnings

import pytest
from conftest import ROOT

import rbfmuscle

sys.path.insert(0, str(ROOT / "docs"))
from gallery import TOPICS

NAMES = [name for name in rbfmuscle.__all__ if name != "__version__"]
# Modules of which every example is run, not the public names' alone.
MODULES = (
    "rbfmuscle.geometry.surfaces",
    "rbfmuscle.geometry.exact_distance",
    "rbfmuscle.validation",
)


def test_reference_has_every_public_name():
    assert sorted(name for names in TOPICS.values() for name in names) == sorted(NAMES)


def run_examples(tests):
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    runner = doctest.DocTestRunner(optionflags=flags)
    for test in tests:
        runner.run(test)
    return runner.summarize(verbose=False)


@pytest.mark.parametrize("name", NAMES)
def test_example_of_a_public_name_runs(name):
    value = getattr(rbfmuscle, name)
    module = importlib.import_module(value.__module__)
    tests = doctest.DocTestFinder(recurse=False).find(value, name, module=module)
    assert sum(len(test.examples) for test in tests) > 0
    with warnings.catch_warnings():
        assert run_examples(tests).failed == 0


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_a_module_run(name):
    module = importlib.import_module(name)
    assert run_examples(doctest.DocTestFinder().find(module)).failed == 0


@pytest.mark.parametrize("name", [n for n in NAMES if inspect.isroutine(getattr(rbfmuscle, n))])
def test_reference_documents_every_parameter(name):
    value = getattr(rbfmuscle, name)
    text = inspect.getdoc(value)
    section = text.split("Parameters\n----------\n")[1].split("\n\n")[0]
    listed = {
        word.strip()
        for line in section.splitlines()
        if not line.startswith(" ")
        for word in line.split(" : ")[0].split(",")
    }
    assert set(inspect.signature(value).parameters) <= listed
