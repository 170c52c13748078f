"""Which modules read a dataset, and the message where one lacks."""

from pathlib import Path
from typing import get_args

import pytest

import drivesplat.readers
from drivesplat.errors import DatasetError
from drivesplat.provenance.code.code_digest import expanded
from drivesplat.readers.datasets import LAYOUT, READER, layout, reader
from drivesplat.readers.sweeps import SWEEP_FILE
from drivesplat.settings.dataset import DatasetSettings

ALLOWED = set(get_args(DatasetSettings.model_fields["reader"].annotation))


def test_every_allowed_reader_has_a_package_with_all_modules_and_every_package_is_allowed():
    packages = {path.parent.name for path in Path(drivesplat.readers.__file__).parent.glob("*/__init__.py")}
    assert packages == ALLOWED
    for pattern in (LAYOUT, READER):
        assert set(expanded(pattern)) == {pattern.replace("*", name) for name in ALLOWED}
    assert set(expanded(SWEEP_FILE)) <= {SWEEP_FILE.replace("*", name) for name in ALLOWED}
    assert SWEEP_FILE.replace("*", "nuscenes") in expanded(SWEEP_FILE)


@pytest.mark.parametrize("module", [layout, reader])
def test_a_missing_reader_is_reported_in_one_sentence(module):
    with pytest.raises(
        DatasetError, match=r"^no module drivesplat\.readers\.toy\.\w+ reads datasets of reader: toy; add"
    ):
        module("toy")
