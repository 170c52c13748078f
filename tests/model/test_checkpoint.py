"""Opening a trained model."""

import doctest

from helpers.hand_made_street import checkpoint_of, street_model

from drivesplat.model import checkpoint
from drivesplat.model.view import View


def test_the_example_of_open_model_renders_a_view(tmp_path, monkeypatch):
    folder = tmp_path / "results/0103/street"
    folder.mkdir(parents=True)
    checkpoint.write_checkpoint(folder / "checkpoint.npz", checkpoint_of(street_model()))
    monkeypatch.chdir(tmp_path)
    names = {**vars(checkpoint), "View": View}
    (example,) = doctest.DocTestFinder(recurse=False).find(checkpoint.open_model, "open_model", globs=names)
    assert len(example.examples) == 5
    assert doctest.DocTestRunner().run(example).failed == 0
