"""Opening a trained model."""

import dataclasses
import doctest
from itertools import cycle

import numpy as np
import pytest
from helpers.hand_made_street import checkpoint_of, street_model

from drivesplat.errors import ResultError
from drivesplat.io.array_file import read_arrays, write_arrays
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


MEANS, SKY = "parts.0.params.means", "sky.params.texels"
DAMAGES = {
    "two columns": lambda model, content: model.update({MEANS: model[MEANS][:, :2]}),
    "fewer rows": lambda model, content: model.update({MEANS: model[MEANS][1:]}),
    "float64": lambda model, content: model.update({MEANS: model[MEANS].astype(np.float64)}),
    "a scalar": lambda model, content: model.update({MEANS: np.zeros((), np.float32)}),
    "a key less": lambda model, content: model.pop(MEANS),
    "a key more": lambda model, content: model.update({"more": np.zeros(3, np.float32)}),
    "a part's key more": lambda model, content: model.update({MEANS + "2": np.zeros(3, np.float32)}),
    "an unknown object": lambda model, content: model.update(
        {"parts.1.params.owner": model["parts.1.params.owner"] + 9}
    ),
    "keys in upper case": lambda model, content: content.update(model={key.upper(): model[key] for key in model}),
    "no parts": lambda model, content: content.update(parts=[]),
    "no provenance": lambda model, content: content.update(provenance={}),
}
"""What changes the arrays or the content of a checkpoint, by a name."""


@pytest.fixture(scope="module")
def whole() -> checkpoint.TrainedCheckpoint:
    """Read only."""
    return checkpoint_of(street_model())


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_checkpoint_of_other_content_is_refused_naming_file_and_rule(whole, tmp_path, damage):
    path = tmp_path / "checkpoint.npz"
    checkpoint.write_checkpoint(path, whole)
    content = read_arrays(path, "train")
    DAMAGES[damage](content["model"], content)
    write_arrays(path, content)
    with pytest.raises(ResultError, match=r"checkpoint\.npz: not a checkpoint .*the rule 'train' rebuilds it") as error:
        checkpoint.trained_model(checkpoint.read_checkpoint(path))
    assert "\n" not in str(error.value)


def test_an_array_that_is_not_finite_is_named(whole, tmp_path):
    path, others = tmp_path / "checkpoint.npz", cycle([np.nan, np.inf, -np.inf])
    for (name, values), value in zip(whole.model.items(), others, strict=False):
        if values.is_floating_point() and values.numel():
            broken = values.clone()
            broken.view(-1)[-1] = value
            checkpoint.write_checkpoint(path, dataclasses.replace(whole, model={**whole.model, name: broken}))
            with pytest.raises(ResultError, match=rf"{name} is not finite\); delete it and rerun: the rule 'train'"):
                checkpoint.read_checkpoint(path)
