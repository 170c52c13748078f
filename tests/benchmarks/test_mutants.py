"""The deliberate faults that the tests must find: each can be applied to the code as it is."""

import pytest
from helpers import REPOSITORY

from benchmarks.mutants import Fault, faulty_file, library_sources, read_faults
from drivesplat.errors import ConfigError


def test_each_fault_changes_one_place_and_names_tests_that_exist():
    faults, sources = read_faults(), library_sources(REPOSITORY)
    assert len({fault.name for fault in faults}) == len(faults) == 30
    for fault in faults:
        changed = sources[faulty_file(fault, sources)].replace(fault.old, fault.new)
        compile(changed, fault.name, "exec")  # a fault is no syntax error
        assert fault.new != fault.old and fault.effect
        assert fault.tests and all((REPOSITORY / test.partition("::")[0]).is_file() for test in fault.tests), fault.name


@pytest.mark.parametrize("texts", [("x = 1", "y = 2"), ("a = b + c", "d = b + c"), ("b + c, b + c",)])
def test_a_text_that_does_not_occur_once_is_refused(tmp_path, texts):
    fault = Fault(name="sum", old="b + c", new="b - c", effect="a wrong sum", tests=("tests/test_sums.py",))
    sources = {tmp_path / f"{number}.py": text for number, text in enumerate(texts)}
    with pytest.raises(ConfigError, match="'old' of sum must occur once"):
        faulty_file(fault, sources)
