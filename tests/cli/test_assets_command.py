"""`drivesplat assets`: collecting is what it does unasked, and imports and exports take their options along."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.hand_made_assets import filled_car

from drivesplat.cli import assets as assets_command
from drivesplat.cli.__main__ import main
from drivesplat.cli.assets import with_action
from drivesplat.editing.assets.asset import read_asset, write_asset
from drivesplat.editing.assets.exchange import FORMATS
from drivesplat.scene.object_class import ObjectClass


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """A folder with an asset in results, where the commands run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("drivesplat.editing.assets.asset_library.write_turntable", lambda path, asset: None)
    source = {"scene": "0061", "method": "street", "track": "6e5c"}
    write_asset(tmp_path / "results/0061/street/assets/6e5c", filled_car(name="0061/street/6e5c", source=source))
    index = {"assets": [{"track": "6e5c", "folder": "6e5c"}]}
    (tmp_path / "results/0061/street/assets/assets.json").write_text(json.dumps(index))
    return tmp_path


def test_assets_are_collected_exported_and_imported(folder, capsys):
    assert main(["assets", "results/", "--out", "library/"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("1 added, 0 replaced") and said.endswith(
        "the library has 1; library/index.html shows them\n"
    )
    assert main(["assets", "collect", "results", "--out", "library", "--class", "car", "--min-psnr", "20"]) == 0
    assert "1 left out; the library has 1" in capsys.readouterr().out
    assert main(["assets", "export", "library/0061_street_6e5c", "--format", "ply", "--out", "out", "--frame=-x,-y,z",
                 "--scale", "0.5"]) == 0  # fmt: skip
    assert capsys.readouterr().out == "out/0061_street_6e5c.ply\n"
    options = ["--frame=-x,-y,z", "--scale", "0.5", "--class", "truck", "--size", "4", "2", "1.5", "--origin", "file"]
    path = "out/0061_street_6e5c.ply"
    assert main(["assets", "import", path, "--out", "library", *options, "--format", "ply", "--name", "mine"]) == 0
    assert capsys.readouterr().out == "added to library: mine; library/index.html shows them\n"
    found, expected = read_asset(folder / "library/mine"), read_asset(folder / "library/0061_street_6e5c")
    np.testing.assert_allclose(found.gaussians.means, expected.gaussians.means, atol=1e-5)
    assert found.object_class is ObjectClass.TRUCK


def test_faults_are_a_sentence(folder, capsys):
    assert main(["assets", "empty", "--out", "library"]) == 1
    assert capsys.readouterr().err == "drivesplat: there is no folder empty\n"
    assert main(["assets", "import", "results", "--out", "library"]) == 1
    assert capsys.readouterr().err.startswith("drivesplat: results is of no known format (asset_harvester, splatsim,")
    for arguments in (["assets"], ["assets", "--help"], ["assets", "import", "--help"]):
        with pytest.raises(SystemExit):
            main(arguments)


def test_the_default_action_is_put_in_where_none_is_named():
    assert with_action(["assets", "results", "--out", "x"]) == ["assets", "collect", "results", "--out", "x"]
    assert with_action(["assets", "--out", "x", "results"]) == ["assets", "collect", "--out", "x", "results"]
    for given in (["assets", "import", "x"], ["assets", "export"], ["assets"], ["assets", "-h"], ["open", "assets"]):
        assert with_action(given) == given


def test_the_formats_of_the_command_line_are_those_that_there_are():
    assert {*assets_command.FORMATS} == {*FORMATS}
