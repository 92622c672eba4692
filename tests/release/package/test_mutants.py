"""The faults of `make mutants` are those of the files as they are now, and name tests that there are."""

import ast

import pytest
from checked import refuses
from mutate import ROOMS, Mutant, read_mutants
from places import ROOT
from started import run_python


def functions_of(path):
    return {node.name for node in ast.walk(ast.parse((ROOT / path).read_text())) if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("room", ROOMS)
def test_faults_stand_once_in_their_files_and_name_tests(room):
    for mutant in read_mutants([room]):
        assert mutant.why and mutant.tests, mutant
        for test in mutant.tests:
            path, _, name = test.partition("::")
            assert not name or name.split("[")[0] in functions_of(path), test


def test_all_tests_that_faults_name_are_there():
    """With their arguments, too: pytest says which it does not find, and no room of such a test runs."""
    named = sorted({test for mutant in read_mutants(list(ROOMS)) for test in mutant.tests})
    run_python("-m", "pytest", "--collect-only", "-q", "-n", "0", "-m", "slow or not slow", *named)


def test_there_are_enough_for_cpus_and_gpus():
    every = read_mutants(list(ROOMS))
    assert sum(not each.gpu for each in every) >= 80
    assert sum(each.gpu for each in every) >= 10
    assert len({(each.file, each.was, each.now) for each in every}) == len(every)


def test_what_stands_there_twice_or_never_is_refused():
    mutant = Mutant("room", "file.py", "a < b", "a <= b", "A tie.", ("test",))
    assert mutant.mutated("if a < b:") == "if a <= b:"
    for text in ("if a > b:", "a < b and a < b"):
        refuses(ValueError, r"once is needed", mutant.mutated, text)
