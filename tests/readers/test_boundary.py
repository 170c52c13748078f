"""No module outside the readers contains a dataset's class names, tables or files."""

import re
from pathlib import Path

import drivesplat
from drivesplat.readers.nuscenes.layout import TABLES

LIBRARY = Path(drivesplat.__file__).parent
KNOWING = ("readers", "world")
WORDS_OF_ITS_OWN = ("calibrated_sensor", "ego_pose", "sample_annotation", "sample_data")
"""The tables whose names are not ordinary words."""
DATASETS_OWN = re.compile(
    r"\b(vehicle|human|movable_object|static_object)\.[a-z_]|\"(vehicle|human)\.\"|\.pcd\b|LIDAR_TOP|KEY_FRAME_US|"
    r"\b500_?000\.0|_token\"\]|" + "|".join(rf"\b{name}\b" for name in WORDS_OF_ITS_OWN)
)
ALLOWED = {"settings/world.py"}
"""The settings of the demo's writer, whose channels are nuScenes'."""


def test_no_module_outside_the_readers_contains_nuscenes_class_names_tables_or_files():
    found = (path.relative_to(LIBRARY) for path in LIBRARY.rglob("*.py"))
    modules = [path for path in found if path.parts[0] not in KNOWING and path.as_posix() not in ALLOWED]
    lines = ((module, line) for module in modules for line in (LIBRARY / module).read_text("utf-8").splitlines())
    assert [(module, line) for module, line in lines if DATASETS_OWN.search(line)] == []


def test_the_searched_words_are_those_of_the_reader():
    readers = "\n".join(path.read_text(encoding="utf-8") for path in (LIBRARY / "readers" / "nuscenes").glob("*.py"))
    found = {match.group() for match in DATASETS_OWN.finditer(readers)}
    assert found >= {"vehicle.c", ".pcd", "LIDAR_TOP", *WORDS_OF_ITS_OWN} and set(WORDS_OF_ITS_OWN) < set(TABLES)
